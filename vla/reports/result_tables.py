"""Tables of results: under conditions, by tier and task, milestones, motion, and rounds; a plot of conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from vla.reports.pictures import BLUE, RED, Panels, plot_rates, save
from vla.reports.tables import DIFFERENCE, Table, difference, duration, in_words, percent, rate
from vla.rollouts.comparison import Comparison
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import Report
from vla.rollouts.sequential import LEVEL
from vla.runs.files import Round

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
ROUNDS = (
    "In every round the expert labelled what the policy of the round before saw, and training went on with that; a "
    "round without episodes is the training on demonstrations alone. Validation has episodes of its own."
)

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


def rate_tables(report: Report) -> list[Table]:
    """Tabulate success by tier and task, instructions completed in a row, milestones and motion."""
    heads = ("success [%]", "episodes")
    tiers = [[name, *rate_of(part)] for name, part in report.by_tier.items()]
    tiers += [[report.mean_label, rate(report.mean_over_tiers), ""]] if report.mean_over_tiers else []
    tasks = [[name, *rate_of(part)] for name, part in report.by_task.items()]
    completed = [[name, *rate_of(report, count)] for name, count in report.in_a_row.items()]
    mean = "; on average {:.2f} ({:.2f}-{:.2f})".format(*report.mean_in_a_row) if report.mean_in_a_row else ""
    milestones = [[name, *rate_of(report, count)] for name, count in report.milestones.items()]
    motion = [[AMOUNTS[name], str(median), str(median.episodes)] for name, median in report.medians.items()]
    return [
        Table(("tier", *heads), tiers, "Success by tier of difficulty", "" if report.anytime else TIERS),
        Table(("task", *heads), tasks, "Success by task"),
        Table(
            ("completed", "episodes [%]", "episodes"),
            completed,
            "Instructions completed in a row",
            f"At least so many{mean}.",
        ),
        Table(("milestone", "reached [%]", "episodes"), milestones, "Milestones", "Whatever the outcome."),
        Table(("", "median", "episodes"), motion, "Motion", MOTION),
    ]


def rounds_table(rounds: Sequence[Round]) -> Table:
    """Tabulate the rounds of `job=improve`."""
    first = int(bool(rounds) and rounds[0].episodes > 0)  # a round without episodes comes before the first one
    rows = [
        [
            *(str(number), str(each.episodes), str(each.successes)),
            "" if each.validation is None else percent(each.validation),
            *(duration(each.collection_s), duration(each.training_s)),
        ]
        for number, each in enumerate(rounds, first)
    ]
    heads = ("round", "labelled episodes", "of these successes", "success in validation afterwards [%]")
    return Table((*heads, "episodes took", "training took"), rows, "Rounds", ROUNDS)


def plot_conditions(reports: Mapping[str, Report], path: Path) -> None:
    """Plot the success rate with its interval per condition."""
    rates = {in_words(name): (report.success, *report.interval) for name, report in reports.items()}
    colours = {name: colour for name in rates for level, colour in LEVELS.items() if name.endswith(f" {level}")}
    panels: Panels = {"success, 95 % CI": partial(plot_rates, rates=rates, colours=colours)}
    save(path, panels, 1, (8, 0.7 + 0.22 * len(rates)))
