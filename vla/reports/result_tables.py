"""Tables of a run's results: success by condition, tier and task, milestones, motion, rounds, and open-loop errors."""

from __future__ import annotations

from vla.reports.conditions import SecondaryRows
from vla.reports.html import DIFFERENCE, PageTable, difference, duration, in_words, rate, secondary
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import Report
from vla.runs.folder import Run
from vla.spec import IN_DISTRIBUTION

TIERS = (
    "The mean over tiers weighs every tier alike, success every episode. The intervals here, and that of success, "
    "treat the tasks as given: only chance within a task counts."
)
MILESTONES = "Share of the episodes in which each milestone was reached, regardless of the outcome."
MOTION = (
    "Medians of the successful episodes, and their 95 % confidence intervals. Log jerk is the logarithm of the "
    "dimensionless jerk of the tool: 5.3 is the smoothest motion from rest to rest, every stop and tremor adds to it."
)


def condition_tables(run: Run) -> list[PageTable]:
    """Tabulate success and secondary metrics under every condition; no rows without others than the training's own."""
    conditions = run.report.conditions if run.report else {}
    found = {name: conditions[name].comparison if name in conditions else None for name in run.reports}
    rows = [[in_words(name), *_rate(each), *difference(found[name])] for name, each in run.reports.items()]
    heads = ("condition", "success [%]", "episodes", f"{DIFFERENCE[0]} from {IN_DISTRIBUTION}", *DIFFERENCE[1:])
    metrics: SecondaryRows = {(name,): part.secondary for name, part in conditions.items()}
    title = f"Secondary metrics under other conditions, as the difference from {IN_DISTRIBUTION}"
    return [
        PageTable(heads, rows if conditions else [], "Success under other conditions, on the same seeds"),
        secondary(metrics, ["condition"], title),
    ]


def rate_tables(report: Report) -> list[PageTable]:
    """Tabulate success by tier and task, instructions completed in a row, milestones and motion."""
    mean, heads = report.mean_over_tiers, ("success [%]", "episodes")
    tiers = [[in_words(name), *_rate(part)] for name, part in report.by_tier.items()]
    tiers += [[report.mean_label, rate(mean), ""]] if mean else []
    tasks = [[in_words(name), *_rate(part)] for name, part in report.by_task.items()]
    completed = [[name, *_rate(report, count)] for name, count in report.in_a_row.items()]
    milestones = [[in_words(name), *_rate(report, count)] for name, count in report.milestones.items()]
    motion = [[AMOUNTS[name], str(median), str(median.episodes)] for name, median in report.medians.items()]
    row = ("completed", "episodes [%]", "episodes")
    return [
        PageTable(("tier", *heads), tiers, "Success by tier of difficulty", "" if report.anytime else TIERS),
        PageTable(("task", *heads), tasks, "Success by task"),
        PageTable(row, completed, "Instructions completed in a row", _in_a_row(report)),
        PageTable(("milestone", "reached [%]", "episodes"), milestones, "Milestones", MILESTONES),
        PageTable(("", "median", "episodes"), motion, "Motion", MOTION),
    ]


def _rate(report: Report, count: int | None = None) -> list[str]:
    """Return the cells of the rate of an event that `count` completed episodes had, by default that of success."""
    interval = report.interval if count is None else report.interval_of(count)
    count = report.successes if count is None else count
    return [rate((count / max(report.episodes, 1), *interval)), f"{count}/{report.episodes}"]


def _in_a_row(report: Report) -> str:
    if report.mean_in_a_row is None:
        return ""
    mean, low, high = (f"{number:.2f}" for number in report.mean_in_a_row)
    return (
        "Share of the episodes in which at least so many instructions, given one after the other, were completed. On "
        f"average {mean} were ({low}-{high})."
    )


def error_table(run: Run) -> PageTable:
    """Tabulate component, error with its interval, and error of a constant action."""
    rows = []
    for each in run.errors.components if run.errors else ():
        unit, error, interval, constant = each.readable()
        rows.append([each.name, f"{error} ({interval}) {unit}", f"{constant} {unit}"])
    note = (
        "Open loop: the policy saw recorded observations, on which its actions have no effect. The errors tell how "
        "well it imitates the recordings, not how often it succeeds. Means over episodes with 95 % confidence "
        "intervals; the constant action is the mean of the training episodes."
    )
    heads = ("component", "mean absolute error", "of the constant action")
    return PageTable(heads, rows, "Errors on held-out recordings", note)


def rounds_table(run: Run) -> PageTable:
    """Tabulate the rounds of `job=improve`."""
    rounds = run.report.rounds if run.report else []
    first = int(bool(rounds) and rounds[0].episodes > 0)  # a round without episodes comes before the first one
    rows = [
        [
            str(number),
            str(each.episodes),
            str(each.successes) if each.episodes else "",
            f"{100 * each.validation:.1f}" if each.validation is not None else "",
            duration(each.collection_s) if each.episodes else "",
            duration(each.training_s),
        ]
        for number, each in enumerate(rounds, first)
    ]
    heads = ("round", "labelled episodes", "of these successes", "success in validation afterwards [%]")
    note = (
        "In every round the expert labelled what the policy of the round before saw, which acted alone or, with "
        "improve.beta, in turns with the expert, and training went on with that; a round without episodes is the "
        "training on demonstrations alone. Validation has other episodes than the success at the top."
    )
    return PageTable((*heads, "episodes took", "training took"), rows, "Rounds", note)
