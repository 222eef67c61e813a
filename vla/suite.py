"""One policy under many conditions, on the same seeds: how much each of them costs."""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from pathlib import Path

import numpy as np
from rich.table import Table

from vla.evaluate import ERROR, Report
from vla.report import GREEN, GREY


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
    """Draw the success rate with its interval under every condition, the first of them as a line for all."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 1.2 + 0.28 * len(reports)), layout="constrained")
    axes = figure.add_subplot()
    rows = np.arange(len(reports))[::-1]
    rates = np.array([report.success for report in reports.values()])
    reach = np.abs(np.array([report.interval for report in reports.values()]).T - rates)
    axes.axvline(rates[0], color=GREY, linewidth=0.8, linestyle="--")
    axes.errorbar(rates, rows, xerr=reach, fmt="o", color=GREEN, ecolor=GREY, capsize=3)
    axes.set_yticks(rows, [name.replace("_", " ") for name in reports])
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.6, len(reports) - 0.4)
    axes.set_xlabel("success, 95 % CI")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
