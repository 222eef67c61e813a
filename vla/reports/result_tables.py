"""Tables of results: under conditions, by tier and task, milestones, motion, and rounds; a plot of conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from vla.reports.pictures import BLUE, RED, Panels, plot_rates, save
from vla.reports.tables import DIFFERENCE, Table, difference, in_words, rate
from vla.rollouts.comparison import SUCCESS, Comparison
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import EventRate, Report
from vla.rollouts.sequential import LEVEL

LEVELS = {"wide": BLUE, "hard": RED}  # end of a condition's name → colour
TASKS = 40  # maximum number of tasks, over all conditions, that are tabulated

TIERS = (
    "The mean weighs every tier alike, success every episode. These intervals, and that of success, treat the tasks as "
    "given: only chance within a task counts."
)
MOTION = (
    "Medians of the successful episodes, and their 95 % confidence intervals. Log jerk is the logarithm of the "
    "dimensionless jerk of the tool: 5.3 is the smoothest motion from rest to rest, every stop and tremor adds to it."
)


def conditions_table(reports: Mapping[str, Report], comparisons: Mapping[str, Mapping[str, Comparison]]) -> Table:
    """Tabulate success and its interval per condition, and its comparison with the first condition.

    Below a condition there is a row for each of its tasks, if it has several and the table stays short. Conditions that
    share the report of the first one, because they change nothing, are named below the table.
    """
    first_name, *names = reports
    equal = [name for name in names if reports[name] is reports[first_name]]
    detailed = sum(len(report.tasks) for report in reports.values()) <= TASKS
    rows = []
    for name, report in reports.items():
        if name not in equal:
            rows.append([name, *cells(report.event_rate()), *difference(comparisons.get(name, {}).get(SUCCESS))])
            tasks = report.tasks if detailed and len(report.tasks) > 1 else {}
            rows += [[f"  {task}", *cells(part.event_rate()), *difference(None)] for task, part in tasks.items()]
    note = f"the same as {first_name}, because they change nothing in the task: {', '.join(equal)}" if equal else ""
    heads = ("condition", "success [%]", "episodes", *DIFFERENCE)
    return Table(heads, rows, "Success under other conditions, on the same seeds", note, ("p",))


def cells(event_rate: EventRate) -> list[str]:
    """Return a rate with its interval, and the episodes, as cells."""
    return [rate((event_rate.rate, event_rate.ci_low, event_rate.ci_high)), f"{event_rate.count}/{event_rate.of}"]


def secondary_table(
    comparisons: Mapping[tuple[str, ...], Mapping[str, Comparison]], heads: Sequence[str] = ("condition",)
) -> Table:
    """Tabulate differences in milestones and motion, in a row per case that has any; `heads` name its columns."""
    cases = {words: metrics for words, metrics in comparisons.items() if {*metrics} - {SUCCESS}}
    unordered = {name for metrics in cases.values() for name in metrics} - {SUCCESS}
    names = [*(name for name in AMOUNTS if name in unordered), *sorted(unordered - {*AMOUNTS})]
    lines = [
        [*words, *(_metric_cell(name, metrics[name]) if name in metrics else "" for name in names)]
        for words, metrics in cases.items()
    ]
    note = (
        "Milestones in all episodes, and medians of the differences in motion where both succeeded, with their 95 % "
        "intervals. Less is faster, shorter, or smoother. *: p Holm of at most 0.05 among all in the table."
    )
    titles = [AMOUNTS.get(name) or f"{in_words(name)} [points]" for name in names]
    return Table([*heads, *titles], lines, "Differences in secondary metrics", note)


def _metric_cell(name: str, test: Comparison) -> str:
    factor, digits = (1, "+.2g") if name in AMOUNTS else (100, "+.1f")
    middle, low, high = (f"{factor * value:{digits}}" for value in (test.difference, test.ci_low, test.ci_high))
    decided = test.p_holm is not None and test.p_holm <= LEVEL
    return f"{middle}{' *' if decided else ''} ({low} to {high})"


def rate_tables(report: Report) -> list[Table]:
    """Tabulate success by tier and task, instructions completed in a row, milestones and motion."""
    rows = {kind: [[name, *cells(counted)] for name, counted in rates.items()] for kind, rates in report.rates.items()}
    if report.mean_over_tiers:
        rows["tiers"].append([report.mean_label, rate(report.mean_over_tiers), ""])
    mean = "; on average {:.2f} ({:.2f}-{:.2f})".format(*report.mean_completed) if report.mean_completed else ""
    motion = [[AMOUNTS[name], str(median), str(median.episodes)] for name, median in report.medians.items()]
    heads = ("rate [%]", "episodes")
    return [
        Table(("tier", *heads), rows["tiers"], "Success by tier of difficulty", "" if report.anytime else TIERS),
        Table(("task", *heads), rows["tasks"], "Success by task"),
        Table(("completed", *heads), rows["in_a_row"], "Instructions completed in a row", f"At least so many{mean}."),
        Table(("milestone", *heads), rows["milestones"], "Milestones reached", "Whatever the outcome."),
        Table(("", "median", "episodes"), motion, "Motion", MOTION),
    ]


def plot_conditions(reports: Mapping[str, Report], path: Path) -> None:
    """Plot the success rate with its interval per condition."""
    rates = {in_words(name): (report.success, *report.interval) for name, report in reports.items()}
    colours = {name: colour for name in rates for level, colour in LEVELS.items() if name.endswith(f" {level}")}
    panels: Panels = {"success, 95 % CI": partial(plot_rates, rates=rates, colours=colours)}
    save(path, panels, 1, (8, 0.7 + 0.22 * len(rates)))
