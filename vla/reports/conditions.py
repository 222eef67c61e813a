"""Tables and plot of one policy under several conditions on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from vla.reports.pictures import BLUE, GREEN, RED, Panels, plot_rates, save
from vla.reports.tables import DIFFERENCE, Table, difference, in_words, rate
from vla.rollouts.comparison import Comparison
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import Report
from vla.rollouts.sequential import LEVEL

LEVELS = {"wide": BLUE, "hard": RED}  # end of a condition's name → colour
TASKS = 40  # maximum number of tasks, over all conditions, that are tabulated

SecondaryRows = Mapping[tuple[str, ...], Mapping[str, Comparison]]  # words that begin a row → comparisons by name


def conditions_table(reports: Mapping[str, Report], compared: Mapping[str, Comparison]) -> Table:
    """Tabulate success and its interval per condition, and its comparison with the first condition.

    Rows below a condition are about each of its tasks, if it has several and the table stays short. Conditions that
    share the report of the first one, because they are the training's own, are named below the table.
    """
    first, *others = reports
    equal = [name for name in others if reports[name] is reports[first]]
    detailed = sum(len(report.tasks) for report in reports.values()) <= TASKS
    rows = []
    for name, report in reports.items():
        if name not in equal:
            rows.append([name, *rate_of(report), *difference(compared.get(name))])
            tasks = report.tasks if detailed and len(report.tasks) > 1 else {}
            rows += [[f"  {task}", *rate_of(part), *difference(None)] for task, part in tasks.items()]
    note = f"as {first}, because they are as in training: {', '.join(equal)}" if equal else ""
    heads = ("condition", "success [%]", "episodes", *DIFFERENCE)
    return Table(heads, rows, "Success under other conditions, on the same seeds", note, ("p",))


def rate_of(report: Report, count: int | None = None) -> list[str]:
    """Return the rate of an event that `count` completed episodes had, by default of success, and both counts."""
    interval = report.interval if count is None else report.interval_of(count)
    count = report.successes if count is None else count
    return [rate((count / max(report.episodes, 1), *interval)), f"{count}/{report.episodes}"]


def secondary_table(rows: SecondaryRows, heads: Sequence[str]) -> Table:
    """Tabulate differences in milestones and motion, as `secondary_of` returns them; `heads` are those of the words."""
    found = {name for metrics in rows.values() for name in metrics}
    names = [*(name for name in AMOUNTS if name in found), *sorted(found - {*AMOUNTS})]
    lines = [
        [*words, *(_secondary(name, metrics[name]) if name in metrics else "" for name in names)]
        for words, metrics in rows.items()
        if metrics
    ]
    note = (
        "Milestones in all episodes, and medians of the differences in motion where both succeeded, with their 95 % "
        "intervals. Less is faster, shorter, or smoother. *: p Holm of at most 0.05 among all in the table."
    )
    titles = [AMOUNTS.get(name) or f"{in_words(name)} [points]" for name in names]
    return Table([*heads, *titles], lines, "Differences in secondary metrics", note)


def _secondary(name: str, found: Comparison) -> str:
    factor, digits = (1, "+.2g") if name in AMOUNTS else (100, "+.1f")
    middle, low, high = (f"{factor * each:{digits}}" for each in (found.difference, found.ci_low, found.ci_high))
    decided = found.p_holm is not None and found.p_holm <= LEVEL
    return f"{middle}{' *' if decided else ''} ({low} to {high})"


def plot_conditions(reports: Mapping[str, Report], path: Path) -> None:
    """Plot the success rate with its interval per condition."""
    rates = {in_words(name): (report.success, *report.interval) for name, report in reports.items()}
    colours = [LEVELS.get(name.rpartition("_")[2], GREEN) for name in reports]
    panels: Panels = {"success, 95 % CI": partial(plot_rates, rates=rates, colours=colours)}
    save(path, panels, 1, (8, 0.7 + 0.22 * len(rates)))
