"""One policy under many conditions, on the same seeds: how much each of them costs."""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from pathlib import Path

import numpy as np
from rich.table import Table

from vla.evaluate import ERROR, Report
from vla.report import BLUE, GREEN, GREY, RED

# What the name of a condition may end with → colour, and how far below the middle of the row.
LEVELS = {"": (GREEN, 0.0), "wide": (BLUE, -0.13), "hard": (RED, 0.13)}


def mcnemar(one: Report, other: Report) -> float:
    """Two-sided exact p-value for equal success of two reports on the same seeds (McNemar 1947).

    Only the episodes count in which one succeeds and the other fails; were both equally good, either would happen
    with probability one half.

    Raises:
        ValueError: the reports are about different seeds.
    """
    pairs = list(zip(one.results, other.results, strict=False))
    if [result.seed for result in one.results] != [result.seed for result in other.results]:
        raise ValueError("only reports on the same seeds can be compared")
    played = [(a.outcome == "success", b.outcome == "success") for a, b in pairs if ERROR not in (a.outcome, b.outcome)]
    lost, won = played.count((True, False)), played.count((False, True))
    tail = sum(comb(lost + won, k) for k in range(min(lost, won) + 1)) / 2 ** (lost + won)
    return min(1.0, 2 * tail)


def suite_table(reports: Mapping[str, Report]) -> Table:
    """One row per condition: success, its interval, and whether it differs from the first condition."""
    table = Table("condition", "success", "of", "%", "95 % CI", "p")
    first = next(iter(reports.values()))
    for name, report in reports.items():
        low, high = report.interval
        p = "" if report is first else f"{mcnemar(first, report):.2g}"
        shares = f"{100 * report.success:.1f}", f"{100 * low:.1f}-{100 * high:.1f}"
        table.add_row(name, str(report.successes), str(report.episodes), *shares, p)
    return table


def plot_suite(reports: Mapping[str, Report], path: Path) -> None:
    """Draw the success rate with its interval under every condition, the first of them as a line for all, and the
    levels of one axis in one row."""
    from matplotlib.figure import Figure

    lines = list(dict.fromkeys(axis for axis, _ in map(_axis_and_level, reports)))
    figure = Figure(figsize=(8, 1.4 + 0.32 * len(lines)), layout="constrained")
    axes = figure.add_subplot()
    axes.axvline(next(iter(reports.values())).success, color=GREY, linewidth=0.8, linestyle="--")
    for level, (colour, below) in LEVELS.items():
        chosen = {
            axis: report for name, report in reports.items() for axis, at in [_axis_and_level(name)] if at == level
        }
        rates = np.array([report.success for report in chosen.values()])
        reach = np.abs(np.array([report.interval for report in chosen.values()]).reshape(-1, 2).T - rates)
        rows = [len(lines) - 1 - lines.index(axis) - below for axis in chosen]
        name = level or None
        axes.errorbar(rates, rows, None, reach, "o", color=colour, ecolor=GREY, capsize=3, label=name, clip_on=False)
    axes.set_yticks(range(len(lines)), [axis.replace("_", " ") for axis in reversed(lines)])
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.6, len(lines) - 0.4)
    if len(lines) < len(reports):
        axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    axes.set_xlabel("success, 95 % CI")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def _axis_and_level(name: str) -> tuple[str, str]:
    """The parts of a condition's name, as in light_hard; most have no level."""
    axis, _, level = name.rpartition("_")
    return (axis, level) if axis and level in LEVELS else (name, "")
