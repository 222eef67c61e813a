"""Output of an evaluation: report.json and report.png."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vla.io.files import write_json
from vla.reports.factors import association, factors, groups, numeric
from vla.reports.style import GREEN, GREY, RED, as_svg, error_bars, rate_limits, save, svg_style
from vla.rollouts.comparison import Comparison
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.statistics import wilson_interval

PANELS = 8  # maximum number of factors on the page
PANEL = (3.4, 2.5)  # of a factor on the page of a run [inch]
LENGTH_BINS = 30  # approximate number of bars in the histogram of lengths


def write_report(
    report: Report,
    path: Path,
    checkpoint: str | None,
    config: Mapping[str, Any],
    facts: Mapping[str, Any] | None = None,
    conditions: Mapping[str, Report] | None = None,
    compared: Mapping[str, Comparison] | None = None,
    secondary: Mapping[str, Mapping[str, Comparison]] | None = None,
) -> None:
    """Write a report as JSON atomically.

    Args:
        report: of the first condition.
        path: of the file.
        checkpoint: the evaluated policy.
        config: the resolved config.
        facts: further entries, such as chosen options, parameters and latency.
        conditions: condition → report on the same seeds.
        compared: condition → comparison of its success with the first.
        secondary: condition → comparisons of its milestones and motion with the first.
    """
    content = {
        **summary(report),
        "seeds": [result.seed for result in report.results],
        "checkpoint": checkpoint,
        **(facts or {}),
        "conditions": {
            name: {
                **summary(other),
                "comparison": asdict(compared[name]) if compared else None,
                "secondary": {key: asdict(each) for key, each in (secondary or {}).get(name, {}).items()},
                "outcomes": [result.outcome for result in other.results],
                "reached": [result.milestones for result in other.results],
                "motions": [result.motion and asdict(result.motion) for result in other.results],
            }
            for name, other in (conditions or {}).items()
        },
        "config": config,
        "per_episode": [asdict(result) for result in report.results],
    }
    write_json(path, content)


def summary(report: Report, of_tier: bool = False) -> dict[str, Any]:
    """Summarise a report for JSON: rate, interval, outcomes, milestones, motion, and the same per task if there
    are several.

    With several instructions per episode also the rates of so many completed in a row, and their mean number.

    With tiers also the same per tier, and the mean over tiers.
    """
    low, high = report.interval
    tiers, mean = {} if of_tier else report.by_tier, report.mean_over_tiers
    return {
        "success": report.success,
        "ci_low": low,
        "ci_high": high,
        "episodes": report.episodes,
        "successes": report.successes,
        "errors": len(report.errors),
        "outcome_counts": report.outcome_counts,
        "milestones": {name: _milestone(report, count) for name, count in report.milestones.items()},
        "motion": {name: asdict(median) for name, median in report.medians.items()},
        **_in_a_row(report),
        "tasks": {task: summary(part) for task, part in report.by_task.items()},
        **({"tiers": {tier: summary(part, True) for tier, part in tiers.items()}} if tiers else {}),
        **({"mean_over_tiers": dict(zip(("rate", "ci_low", "ci_high"), mean, strict=True))} if mean else {}),
        **({"anytime": True} if report.anytime else {}),
    }


def _in_a_row(report: Report) -> dict[str, Any]:
    if (mean := report.mean_in_a_row) is None:
        return {}
    return {
        "in_a_row": {name: _milestone(report, count) for name, count in report.in_a_row.items()},
        "mean_in_a_row": dict(zip(("number", "ci_low", "ci_high"), mean, strict=True)),
    }


def _milestone(report: Report, count: int) -> dict[str, Any]:
    low, high = report.interval_of(count)
    return {"rate": count / max(report.episodes, 1), "ci_low": low, "ci_high": high, "episodes": count}


def plot_report(report: Report, path: Path) -> None:
    """Plot outcomes, episode lengths, and success over the randomised factors with the strongest association."""
    played, shown = _strongest(report)
    rows = 1 + -(-len(shown) // 4)
    figure = Figure(figsize=(13, 3.1 * rows))
    inch = 1 / (3.1 * rows)
    figure.suptitle(str(report).splitlines()[-1], y=1 - 0.15 * inch, va="top", fontsize=15, fontweight="bold")
    edges = {"right": 0.985, "bottom": 0.65 * inch, "top": 1 - 0.8 * inch}
    grid = figure.add_gridspec(rows, 4, **edges, wspace=0.3, hspace=0.4)
    outcomes = figure.add_subplot(grid[0, :2])
    _plot_outcomes(outcomes, report)
    # Only the left margin depends on what is drawn; a layout engine takes as long as drawing the figure twice.
    names = outcomes.bbox.x0 - outcomes.yaxis.get_tightbbox().x0
    grid.update(left=max(0.01 + names / figure.bbox.width, 0.06))
    outcomes.set_position(grid[0, :2].get_position(figure))
    _plot_lengths(figure.add_subplot(grid[0, 2:]), played)
    scales = list[Axes]()
    for index, (name, values) in enumerate(shown):
        axes = figure.add_subplot(grid[1 + index // 4, index % 4])
        axes.set_title(name, fontsize=10)
        _plot_factor(axes, values, played)
        if not isinstance(values[0], tuple):
            scales.append(axes)
    limits = rate_limits(min((axes.dataLim.y0 for axes in scales), default=0.0))  # data are the intervals
    for axes in scales:
        axes.set_ylim(limits)
    save(figure, path)


def factor_panels(report: Report) -> dict[str, str]:
    """Return title → SVG: lengths of the episodes, and success over the factors of `plot_report`."""
    played, shown = _strongest(report)
    panels = {"length of episodes": _panel("length of episodes", partial(_plot_lengths, played=played))}
    for name, values in shown:
        panels[name] = _panel(name, partial(_plot_factor, values=values, played=played))
    return panels if played else {}


def _panel(title: str, plot: Callable[[Axes], None]) -> str:
    with svg_style(title):
        figure = Figure(figsize=PANEL, layout="constrained")
        axes = figure.add_subplot()
        plot(axes)
        axes.set_title("", loc="left")  # the page has it
        axes.spines[["top", "right"]].set_visible(False)
        return as_svg(figure)


def _strongest(report: Report) -> tuple[list[Result], list[tuple[str, list[Any]]]]:
    """Return the completed episodes, and title and values of the factors most strongly associated with success."""
    played = [result for result in report.results if result.outcome != ERROR]
    return played, sorted(factors(played).items(), key=lambda factor: -association(factor[1], played))[:PANELS]


def _plot_factor(axes: Axes, values: Sequence[Any], played: Sequence[Result]) -> None:
    if isinstance(values[0], tuple):
        _plot_points(axes, values, played)
    else:
        _plot_groups(axes, values, played)
        axes.set_ylim(0, 1)


def _plot_outcomes(axes: Axes, report: Report) -> None:
    """Plot one bar per outcome, and the interval of the success rate."""
    names, counts = list(report.outcome_counts)[::-1], list(report.outcome_counts.values())[::-1]
    colours = [GREEN if name == "success" else GREY if name == ERROR else RED for name in names]
    axes.barh([name.replace("_", " ") for name in names], counts, color=colours, height=0.7)
    low, high = (bound * report.episodes for bound in report.interval)
    for row, (name, count) in enumerate(zip(names, counts, strict=True)):
        axes.annotate(
            str(count), (high if name == "success" else count, row), (6, 0), textcoords="offset points", va="center"
        )
        if name == "success":
            axes.plot([low, high], [row, row], color="black", linewidth=1.5, marker="|", markersize=10)
    axes.set_xlim(0, 1.1 * len(report.results))
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel("episodes")
    axes.set_title("outcomes", fontsize=10, loc="left")


def _plot_lengths(axes: Axes, played: Sequence[Result]) -> None:
    """Plot a histogram of the steps until success or failure."""
    steps = [[result.steps for result in played if result.success == good] for good in (True, False)]
    lengths = steps[0] + steps[1] or [0]
    width = max(1, round((max(lengths) - min(lengths)) / LENGTH_BINS))
    edges = np.arange(min(lengths), max(lengths) + width + 1, width) - 0.5  # whole numbers lie inside the bins
    axes.hist(steps, bins=list(edges), stacked=True, color=[GREEN, RED], label=["success", "failure"])
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    axes.set_xlabel("steps")
    axes.locator_params(integer=True)
    axes.set_ylabel("episodes")
    axes.set_title("length of episodes", fontsize=10, loc="left")


def _plot_points(axes: Axes, values: Sequence[tuple[float, float]], played: Sequence[Result]) -> None:
    """Scatter successes and failures over a two-dimensional factor, failures on top."""
    for good, colour, marker in ((True, GREEN, "o"), (False, RED, "X")):
        points = [value for value, result in zip(values, played, strict=True) if result.success == good]
        across, along = np.array(points).reshape(-1, 2).T
        axes.scatter(across, along, c=colour, marker=marker, s=22, alpha=0.75, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")


def _plot_groups(axes: Axes, values: Sequence[Any], played: Sequence[Result]) -> None:
    """Plot the success rate with its interval per group of values; a group of numbers is placed at its mean."""
    split = groups(values)
    if numeric(values):
        places = [float(np.mean([values[index] for index in group])) for group in split]
        whole = all(isinstance(value, int) for value in values)
        axes.locator_params(axis="x", nbins=4, integer=whole)  # long tick labels would overlap
    else:
        places = list(range(len(split)))
        names = [str(values[group[0]]) for group in split]
        tilt = 20 if max(map(len, names)) > 9 else 0
        axes.set_xticks(places, names, fontsize=8, rotation=tilt, ha="right" if tilt else "center")
        axes.set_xlim(-0.5, len(split) - 0.5)
    won = [sum(played[index].success for index in group) for group in split]
    counts = [(good, len(group)) for good, group in zip(won, split, strict=True)]
    rates, reach = error_bars((good / count, *wilson_interval(good, count)) for good, count in counts)
    axes.errorbar(places, rates, reach, fmt="o-", color=GREEN, ecolor=GREY, linewidth=0.7, capsize=3, clip_on=False)
    axes.set_ylabel("success")
    axes.grid(axis="y", alpha=0.3)
