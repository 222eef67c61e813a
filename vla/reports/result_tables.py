"""Tables of a run's results: success by tier and task, milestones, motion, and rounds."""

from __future__ import annotations

from vla.reports.conditions import rate_of
from vla.reports.tables import Table, duration, rate
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import Report
from vla.runs.folder import Run

TIERS = (
    "The mean over tiers weighs every tier alike, success every episode. The intervals here, and that of success, "
    "treat the tasks as given: only chance within a task counts."
)
MOTION = (
    "Medians of the successful episodes, and their 95 % confidence intervals. Log jerk is the logarithm of the "
    "dimensionless jerk of the tool: 5.3 is the smoothest motion from rest to rest, every stop and tremor adds to it."
)
ROUNDS = (
    "In every round the expert labelled what the policy of the round before saw, which acted alone or, with "
    "improve.beta, in turns with the expert, and training went on with that; a round without episodes is the "
    "training on demonstrations alone. Validation has other episodes than the success at the top."
)


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


def rounds_table(run: Run) -> Table:
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
    return Table((*heads, "episodes took", "training took"), rows, "Rounds", ROUNDS)
