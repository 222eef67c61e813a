"""Tables and plot of one policy under several conditions on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from vla.reports.style import BLUE, GREEN, GREY, RED, error_bars, rate_limits, save
from vla.rollouts.comparison import Comparison
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import Report
from vla.rollouts.sequential import LEVEL

# Suffix of a condition's name → colour, and vertical offset within the row.
LEVELS = {"": (GREEN, 0.0), "wide": (BLUE, -0.13), "hard": (RED, 0.13)}
TASKS = 40  # maximum number of tasks, over all conditions, that are tabulated
COMPARED = ("points (95 % CI)", "p Holm", "verdict")  # heads of `short_texts`
NARROW: dict[str, Any] = {"box": SIMPLE_HEAD, "collapse_padding": True, "pad_edge": False}  # fits 80 columns
DECIDED = "p Holm of at most 0.05"

SecondaryRows = Mapping[tuple[str, ...], Mapping[str, Comparison]]  # words that begin a row → comparisons by name


def conditions_table(reports: Mapping[str, Report], compared: Mapping[str, Comparison]) -> Table:
    """Tabulate success and its interval per condition, and its comparison with the first condition.

    Rows below a condition are about each of its tasks, if it has several and the table stays short. Conditions that
    share the report of the first one, because they are the training's own, are named below the table.
    """
    first, *others = reports
    equal = [name for name in others if reports[name] is reports[first]]
    detailed = sum(len(report.tasks) for report in reports.values()) <= TASKS
    caption = f"as {first}, because they are as in training: {', '.join(equal)}" if equal else None
    table = Table("condition", "success", "% (95 % CI)", *COMPARED, **NARROW, caption=caption)
    for name, report in reports.items():
        if name in equal:
            continue
        table.add_row(name, *_rate(report), *(short_texts(compared[name]) if name in compared else ()))
        for task, part in report.tasks.items() if detailed and len(report.tasks) > 1 else ():
            table.add_row(f"  {task}", *_rate(part))
    return table


def _rate(report: Report) -> tuple[str, str]:
    """Format successes of episodes, and the success rate with its interval."""
    low, high = (f"{100 * bound:.1f}" for bound in report.interval)
    return f"{report.successes}/{report.episodes}", f"{100 * report.success:.1f} ({low}-{high})"


def comparison_texts(compared: Comparison) -> tuple[str, str, str, str, str]:
    """Format difference and interval in percentage points, both p-values, and the verdict."""
    difference, low, high = (
        f"{100 * share:+.1f}" for share in (compared.difference, compared.ci_low, compared.ci_high)
    )
    together = "" if compared.p_holm is None else f"{compared.p_holm:.2g}"
    return difference, f"{low} to {high}", f"{compared.p:.2g}", together, compared.verdict


def short_texts(compared: Comparison) -> tuple[str, str, str]:
    """Format the difference with its interval in percentage points, the adjusted p-value, and the verdict."""
    difference, interval, _, together, verdict = comparison_texts(compared)
    return f"{difference} ({interval})", together, verdict


def secondary_table(rows: SecondaryRows, heads: Sequence[str]) -> Table:
    """Tabulate differences in milestones and motion, as `secondary_of` returns them; `heads` are those of the words."""
    names = secondary_names(rows)
    table = Table(
        *heads,
        *(escape(secondary_head(name)) for name in names),
        **NARROW,
        caption=f"differences in secondary metrics; * {DECIDED}",
    )
    for words, metrics in rows.items():
        texts = [secondary_texts(name, metrics[name]) if name in metrics else ("", "", False) for name in names]
        table.add_row(*words, *(f"{difference} *" if decided else difference for difference, _, decided in texts))
    return table


def secondary_names(rows: SecondaryRows) -> list[str]:
    """Return the names of the compared metrics: fields of `Motion`, then milestones."""
    found = {name for metrics in rows.values() for name in metrics}
    return [*(name for name in AMOUNTS if name in found), *sorted(found - {*AMOUNTS})]


def secondary_head(name: str) -> str:
    """Return the head of a column of differences, with the unit."""
    return AMOUNTS.get(name) or f"{name.replace('_', ' ')} [points]"


def secondary_texts(name: str, compared: Comparison) -> tuple[str, str, bool]:
    """Format a difference and its interval, and tell whether it is decided."""
    factor, digits = (1, "+.2g") if name in AMOUNTS else (100, "+.1f")
    difference, low, high = (
        f"{factor * share:{digits}}" for share in (compared.difference, compared.ci_low, compared.ci_high)
    )
    return difference, f"{low} to {high}", compared.p_holm is not None and compared.p_holm <= LEVEL


def plot_conditions(reports: Mapping[str, Report], path: Path) -> None:
    """Plot the success rate with its interval per condition, levels of one axis in one row, the first as a line."""
    lines = list(dict.fromkeys(axis for axis, _ in map(_axis_and_level, reports)))
    figure = Figure(figsize=(8, 1.4 + 0.32 * len(lines)), layout="constrained")
    axes = figure.add_subplot()
    axes.axvline(next(iter(reports.values())).success, color=GREY, linewidth=0.8, linestyle="--")
    for level, (colour, below) in LEVELS.items():
        chosen = {
            axis: report for name, report in reports.items() for axis, at in [_axis_and_level(name)] if at == level
        }
        rates, reach = error_bars((report.success, *report.interval) for report in chosen.values())
        rows = [len(lines) - 1 - lines.index(axis) - below for axis in chosen]
        name = level or "one level"
        axes.errorbar(rates, rows, None, reach, "o", color=colour, ecolor=GREY, capsize=3, label=name, clip_on=False)
    axes.set_yticks(range(len(lines)), [axis.replace("_", " ") for axis in reversed(lines)])
    axes.set_xlim(rate_limits(min(report.interval[0] for report in reports.values())))
    axes.set_ylim(-0.6, len(lines) - 0.4)
    if len(lines) < len(reports):
        axes.legend(frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    axes.set_xlabel("success, 95 % CI")
    axes.grid(axis="x", alpha=0.3)
    save(figure, path)


def _axis_and_level(name: str) -> tuple[str, str]:
    """Split a condition's name such as light_hard into axis and level; the level is empty if there is none."""
    axis, _, level = name.rpartition("_")
    return (axis, level) if axis and level in LEVELS else (name, "")
