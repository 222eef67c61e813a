"""Panels of an evaluation's episodes: outcomes, lengths, and success over what was randomised."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vla.data.episode_filter import flatten
from vla.reports.pictures import GREEN, GREY, RED, Panels, error_bars, plot_counts, rate_limits
from vla.reports.tables import in_words
from vla.rollouts.results import ERROR, Rate, Report, Result
from vla.rollouts.statistics import wilson_interval

BINS = 5  # quantile groups of a numeric factor
GROUPS, FACTORS = 8, 8  # maximum number of groups of a factor, and of factors that are drawn
LENGTH_BINS = 30  # approximate number of bars in the histogram of lengths


def factors(results: Sequence[Result]) -> dict[str, list[Any]]:
    """Return name → value per episode, for every draw that all episodes have and that forms 2 to `GROUPS` groups.

    A pair of floats is a point; each item of any other list is a factor. Of draws with equal values the first counts.
    """
    rows = [dict(item for draw in flatten(result.draws).items() for item in _items(*draw)) for result in results]
    columns = dict[str, list[Any]]()
    for name in rows[0] if rows else ():
        values = [row.get(name) for row in rows]
        if None not in values and values not in columns.values():
            columns[name] = values
    return {name: values for name, values in columns.items() if 1 < len(groups(values)) <= GROUPS}


def _items(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        if len(value) == 2 and all(isinstance(item, float) for item in value):
            yield name, tuple(value)
        else:
            for index, item in enumerate(value):
                yield from _items(f"{name}[{index}]", item)
    elif not isinstance(value, dict):  # an object in a list forms no groups
        yield name, value


def are_numeric(values: Sequence[Any]) -> bool:
    """Return whether all values are numbers."""
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def groups(values: Sequence[Any]) -> list[list[int]]:
    """Group the indices of episodes: few values or words by value, other numbers by quantiles, points by quadrants."""
    if isinstance(values[0], tuple):
        values = [str(quarter) for quarter in np.array(values) > np.median(values, axis=0)]
    levels = sorted(set(values), key=None if are_numeric(values) else str)
    if len(levels) <= BINS or not are_numeric(values):
        indices = {value: list[int]() for value in levels}
        for index, value in enumerate(values):
            indices[value].append(index)
        return [*indices.values()]
    return [group.tolist() for group in np.array_split(np.argsort(values, kind="stable"), BINS)]


def association(values: Sequence[Any], results: Sequence[Result]) -> float:
    """Association of success, which must vary, with a factor: Pearson's χ² per degree of freedom, about 1 by chance."""
    successes = np.array([result.success for result in results], dtype=float)
    rate, split = successes.mean(), groups(values)
    squares = sum(len(group) * (successes[group].mean() - rate) ** 2 for group in split)
    return float(squares / (rate * (1 - rate)) / (len(split) - 1))


def episode_panels(report: Report) -> Panels:
    """Return panels of outcomes, lengths, and success over the factors with the strongest association.

    Factors are left out if all episodes succeeded, or none.
    """
    played = [result for result in report.results if result.outcome != ERROR]
    candidates = factors(played) if len({result.success for result in played}) > 1 else {}
    selection = dict(sorted(candidates.items(), key=lambda factor: -association(factor[1], played))[:FACTORS])
    rates = {name: _rates_of(values, played) for name, values in selection.items() if not isinstance(values[0], tuple)}
    limits = rate_limits(min((low for intervals in rates.values() for _, low, _ in intervals), default=0.0))  # shared
    outcomes = {in_words(name): count for name, count in report.outcome_counts.items()}
    colours = [{"success": GREEN, ERROR: GREY}.get(name, RED) for name in report.outcome_counts]
    panels: Panels = {
        "outcomes": partial(plot_counts, counts=outcomes, colours=colours),
        "length of episodes [steps]": partial(_plot_lengths, played=played),
    }
    for name, values in selection.items():
        if name in rates:
            panels[name] = partial(_plot_rates, values=values, rates=rates[name], limits=limits)
        else:
            panels[name] = partial(_plot_points, points=values, played=played)
    return panels


def _plot_lengths(axes: Axes, played: Sequence[Result]) -> None:
    """Plot a histogram of the steps until success or failure."""
    steps = [[result.steps for result in played if result.success == good] for good in (True, False)]
    lengths = steps[0] + steps[1] or [0]
    width = max(1, round((max(lengths) - min(lengths)) / LENGTH_BINS))
    edges = np.arange(min(lengths), max(lengths) + width + 1, width) - 0.5  # whole numbers lie inside the bins
    axes.hist(steps, bins=list(edges), stacked=True, color=[GREEN, RED])
    axes.locator_params(integer=True, nbins=5, min_n_ticks=1)  # of equal lengths there is one


def _plot_points(axes: Axes, points: Sequence[tuple[float, float]], played: Sequence[Result]) -> None:
    """Scatter successes and failures over a two-dimensional factor, failures on top."""
    for good, colour, marker in ((True, GREEN, "o"), (False, RED, "X")):
        subset = [point for point, result in zip(points, played, strict=True) if result.success == good]
        x, y = np.array(subset).reshape(-1, 2).T
        axes.scatter(x, y, c=colour, marker=marker, s=16, alpha=0.75, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")


def _rates_of(values: Sequence[Any], played: Sequence[Result]) -> list[Rate]:
    """Return the success rate of each group of a factor, with its interval."""
    counts = [(sum(played[index].success for index in group), len(group)) for group in groups(values)]
    return [(successes / count, *wilson_interval(successes, count)) for successes, count in counts]


def _plot_rates(axes: Axes, values: Sequence[Any], rates: Sequence[Rate], limits: tuple[float, float]) -> None:
    """Plot the success rate with its interval per group of values; a group of numbers is placed at its mean."""
    split = groups(values)
    if are_numeric(values):
        places = [float(np.mean([values[index] for index in group])) for group in split]
        whole = all(isinstance(value, int) for value in values)
        axes.locator_params(axis="x", nbins=4, integer=whole)  # long tick labels would overlap
    else:
        places = list(range(len(split)))
        axes.set_xticks(places, [str(values[group[0]])[:10] for group in split], fontsize=8)
        axes.set_xlim(-0.5, len(split) - 0.5)
    middle, reach = error_bars(rates)
    axes.errorbar(places, middle, reach, fmt="o-", color=GREEN, ecolor=GREY, linewidth=0.7, capsize=3, clip_on=False)
    axes.set_ylim(limits)
    axes.grid(axis="y", alpha=0.2)
