"""Output of an evaluation: report.json and report.png."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vla.io.files import write_json
from vla.reports.factors import association, factors, groups, numeric
from vla.reports.pictures import GREEN, GREY, RED, Interval, Panels, error_bars, plot_counts, rate_limits, save
from vla.reports.tables import in_words
from vla.rollouts.comparison import Comparison
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.statistics import wilson_interval

FACTORS = 8  # maximum number of factors that are drawn
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
    """Summarise a report for JSON: rates with intervals, outcomes, milestones, motion, and the same per task if there
    are several, and per tier; of several instructions per episode also how many were completed in a row."""
    low, high = report.interval
    found: dict[str, Any] = {
        "success": report.success,
        "ci_low": low,
        "ci_high": high,
        "episodes": report.episodes,
        "successes": report.successes,
        "errors": len(report.errors),
        "outcome_counts": report.outcome_counts,
        "milestones": {name: _share(report, count) for name, count in report.milestones.items()},
        "motion": {name: asdict(median) for name, median in report.medians.items()},
        "tasks": {task: summary(part) for task, part in report.by_task.items()},
    }
    if mean := report.mean_in_a_row:
        found["in_a_row"] = {name: _share(report, count) for name, count in report.in_a_row.items()}
        found["mean_in_a_row"] = dict(zip(("number", "ci_low", "ci_high"), mean, strict=True))
    if not of_tier and report.by_tier:
        found["tiers"] = {tier: summary(part, True) for tier, part in report.by_tier.items()}
    if mean := report.mean_over_tiers:
        found["mean_over_tiers"] = dict(zip(("rate", "ci_low", "ci_high"), mean, strict=True))
    return found | ({"anytime": True} if report.anytime else {})


def _share(report: Report, count: int) -> dict[str, Any]:
    low, high = report.interval_of(count)
    return {"rate": count / max(report.episodes, 1), "ci_low": low, "ci_high": high, "episodes": count}


def plot_report(report: Report, path: Path) -> None:
    """Plot outcomes, episode lengths, and success over the randomised factors with the strongest association."""
    save(path, report_panels(report), 4, title=str(report).splitlines()[-1])


def report_panels(report: Report) -> Panels:
    """Return the panels of `plot_report`."""
    played = [result for result in report.results if result.outcome != ERROR]
    ordered = sorted(factors(played).items(), key=lambda factor: -association(factor[1], played))
    shown = dict(ordered[:FACTORS])
    rates = {name: _rates_of(values, played) for name, values in shown.items() if not isinstance(values[0], tuple)}
    limits = rate_limits(min((low for each in rates.values() for _, low, _ in each), default=0.0))  # shared
    panels: Panels = {
        "outcomes": partial(_plot_outcomes, report=report),
        "length of episodes [steps]": partial(_plot_lengths, played=played),
    }
    for name, values in shown.items():
        if name in rates:
            panels[name] = partial(_plot_rates, values=values, rates=rates[name], limits=limits)
        else:
            panels[name] = partial(_plot_points, points=values, played=played)
    return panels


def _plot_outcomes(axes: Axes, report: Report) -> None:
    counts = report.outcome_counts
    colours = [GREEN if name == "success" else GREY if name == ERROR else RED for name in counts]
    plot_counts(axes, {in_words(name): count for name, count in counts.items()}, colours)


def _plot_lengths(axes: Axes, played: Sequence[Result]) -> None:
    """Plot a histogram of the steps until success or failure."""
    steps = [[result.steps for result in played if result.success == good] for good in (True, False)]
    lengths = steps[0] + steps[1] or [0]
    width = max(1, round((max(lengths) - min(lengths)) / LENGTH_BINS))
    edges = np.arange(min(lengths), max(lengths) + width + 1, width) - 0.5  # whole numbers lie inside the bins
    axes.hist(steps, bins=list(edges), stacked=True, color=[GREEN, RED])
    axes.locator_params(integer=True, nbins=5)


def _plot_points(axes: Axes, points: Sequence[tuple[float, float]], played: Sequence[Result]) -> None:
    """Scatter successes and failures over a two-dimensional factor, failures on top."""
    for good, colour, marker in ((True, GREEN, "o"), (False, RED, "X")):
        chosen = [point for point, result in zip(points, played, strict=True) if result.success == good]
        across, along = np.array(chosen).reshape(-1, 2).T
        axes.scatter(across, along, c=colour, marker=marker, s=16, alpha=0.75, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")


def _rates_of(values: Sequence[Any], played: Sequence[Result]) -> list[Interval]:
    """Return the success rate of each group of a factor, with its interval."""
    counts = [(sum(played[index].success for index in group), len(group)) for group in groups(values)]
    return [(good / count, *wilson_interval(good, count)) for good, count in counts]


def _plot_rates(axes: Axes, values: Sequence[Any], rates: Sequence[Interval], limits: tuple[float, float]) -> None:
    """Plot the success rate with its interval per group of values; a group of numbers is placed at its mean."""
    split = groups(values)
    if numeric(values):
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
