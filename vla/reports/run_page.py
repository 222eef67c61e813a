"""The page of a run, `report.html`."""

from __future__ import annotations

import os
from pathlib import Path

from vla.config.differences import ABSENT, at
from vla.config.origin import Origin
from vla.data.index import listed
from vla.io.files import warn_on_error
from vla.reports.conditions import SecondaryRows
from vla.reports.evaluation import factor_panels
from vla.reports.html import (
    DIFFERENCE,
    PageTable,
    code,
    difference,
    duration,
    filled,
    in_words,
    rate,
    render,
    secondary,
    value,
)
from vla.reports.index import INDEX, RUNS, Entry, write_index
from vla.reports.training_curves import draw_run
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.moving_picture import read_moving_pictures
from vla.rollouts.recordings import shown
from vla.rollouts.results import ERROR, Report
from vla.runs.folder import ERRORS_PLOT, PAGE, RECORDING, RECORDINGS, SAMPLES, Run, read_run
from vla.spec import IN_DISTRIBUTION

NAMED = 5  # maximum number of tasks in a title


def write_page(folder: Path) -> Path:
    """Write the page of a run from the files in its folder, and return its path; missing files are omitted.

    In a folder named `runs` that lists them, the list is written again.

    Raises:
        ValueError: a file is damaged.
    """
    run = read_run(folder)
    pictures = read_moving_pictures(folder / RECORDINGS)
    page = render(
        folder / PAGE,
        "run.html",
        title=_title(run),
        run=run,
        entry=_entry(run).to_json(),
        several=len(run.reports) > 1,
        anytime=any(report.anytime for report in run.reports.values()),
        facts=_facts(run),
        all_steps=at(run.config, "trainer.max_steps", None),
        tables=filled(_rate_tables(run)),
        report=run.reports.get(IN_DISTRIBUTION),
        panels=factor_panels(run.reports[IN_DISTRIBUTION]) if run.report else {},
        errors=_error_table(run),
        rounds=_rounds_table(run),
        curves=draw_run(run.metrics),
        recorded=_recorded(run),
        recording=RECORDING if (folder / RECORDING).is_file() else None,
        rollouts=[(caption, pictures[caption]) for caption in shown(pictures)],
        pictures={name: folder / name for name in (SAMPLES, ERRORS_PLOT) if (folder / name).is_file()},
        origins=_origins(run),
        changes=_changes_table(run),
    )
    runs = folder.resolve().parent
    if runs.name == RUNS:
        with warn_on_error(runs / INDEX):
            write_index(runs)
    return page


def _title(run: Run) -> str:
    tasks = ", ".join(run.tasks) if len(run.tasks) <= NAMED else f"{len(run.tasks)} tasks"
    return " · ".join(part for part in (run.policy, in_words(tasks)) if part) or run.folder.resolve().name


def _entry(run: Run) -> Entry:
    """Return what a list of runs says of a run."""
    tasks = [in_words(task) for task in run.tasks] or [
        _class(run, "task.goal._target_") or _class(run, "task._target_")
    ]
    report, ended = run.reports.get(IN_DISTRIBUTION), run.training.ended if run.training else "done"
    return Entry(
        policy=run.policy,
        task=", ".join(tasks) if len(tasks) <= NAMED else f"{len(tasks)} tasks",
        success=(report.success, *report.interval) if report else None,
        episodes=report.episodes if report else None,
        remark="" if ended == "done" else ended if ended == "interrupted" else "failed",
    )


def _class(run: Run, key: str) -> str:
    return str(at(run.config, key, "")).rpartition(".")[2]


def _facts(run: Run) -> dict[str, str]:
    """Return the facts at the top of a run's page: name → text."""
    training, report = run.training, run.report or run.errors
    facts = {}
    if run.parameters is not None:
        facts["parameters"] = f"{run.parameters / 1e6:.2f} M"
    if report and report.latency_ms:
        facts["time per action"] = f"{report.latency_ms:.1f} ms"
    if training:
        facts["training"] = f"{training.steps} steps in {duration(training.seconds)}"
    if report and report.wall_time_s:
        of_another = "evaluation, and training of the policy" if report.checkpoint else "evaluation"
        parts = "collection, training, evaluation" if training else of_another
        facts[parts] = duration(report.wall_time_s)
    if run.metrics and (demonstrations := at(run.config, "collect.episodes")) != ABSENT:
        facts["demonstrations"] = str(demonstrations)
    if report and report.seeds:
        seeds = f"seeds {min(report.seeds)} to {max(report.seeds)}"
        facts["evaluated on"] = seeds if run.report else f"the held-out episodes {listed(report.seeds)}"
    if report and report.checkpoint:
        facts["checkpoint"] = str(_checkpoint(run, report.checkpoint))
    return facts


def _checkpoint(run: Run, checkpoint: str) -> Path:
    """Return the path of a checkpoint, within the folder of the run if it is there."""
    folder, path = (Path(os.path.realpath(each)) for each in (run.folder, checkpoint))
    return path.relative_to(folder) if path.is_relative_to(folder) else Path(checkpoint)


def _origins(run: Run) -> dict[str, dict[str, str]]:
    """Return part of the work → name and text of what is known of its origin; a single part if all are alike."""
    begun, evaluated = run.training.origins if run.training else [], run.report or run.errors
    known = {f"training, part {part}" if part > 1 else "training": each for part, each in enumerate(begun, 1)}
    if evaluated and evaluated.origin:
        known["evaluation"] = evaluated.origin
    alike = len({str(origin) for origin in known.values()}) == 1
    return {"": _of(next(iter(known.values())))} if alike else {name: _of(origin) for name, origin in known.items()}


def _of(origin: Origin) -> dict[str, str]:
    commits = ", ".join(f"{commit} ({tree})" for tree, commit in origin.commits.items())
    facts = {"git commit": commits, "host": origin.host, "processor": origin.processor}
    return {
        name: fact
        for name, fact in {"command": code(origin.command) if origin.command else "", **facts}.items()
        if fact
    }


def _recorded(run: Run) -> str:
    """Return a sentence on which episodes the recording has; empty if that is unknown."""
    if not run.report or not run.report.recorded:
        return ""
    played, recorded = run.reports[IN_DISTRIBUTION].results, {*run.report.recorded}
    parts = list[str]()
    for name, good in (("failures", False), ("successes", True)):
        if found := [each.seed in recorded for each in played if each.success == good and each.outcome != ERROR]:
            parts.append(f"{sum(found)} of {len(found)} {name}")
    return f"{RECORDING} has {' and '.join(parts)}"


def _error_table(run: Run) -> PageTable:
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


def _rate_tables(run: Run) -> list[PageTable]:
    """Tabulate success by condition, tier and task, milestones and motion."""
    seen, conditions = run.reports.get(IN_DISTRIBUTION, Report(())), run.report.conditions if run.report else {}
    mean = seen.mean_over_tiers
    heads = ("condition", "success [%]", "episodes", *(f"{head} from {IN_DISTRIBUTION}" for head in DIFFERENCE[:1]))
    found = {name: conditions[name].comparison if name in conditions else None for name in run.reports}
    rows = [[in_words(name), *_rate(each), *difference(found[name])] for name, each in run.reports.items()]
    metrics: SecondaryRows = {(name,): part.secondary for name, part in conditions.items()}
    tiers = [[in_words(name), *_rate(part)] for name, part in seen.by_tier.items()]
    tiers += [[seen.mean_label, rate(mean), ""]] if mean else []
    tasks = [[in_words(name), *_rate(part)] for name, part in seen.by_task.items()]
    completed = [[name, *_rate(seen, count)] for name, count in seen.in_a_row.items()]
    milestones = [[in_words(name), *_rate(seen, count)] for name, count in seen.milestones.items()]
    motion = [[AMOUNTS[name], str(median), str(median.episodes)] for name, median in seen.medians.items()]
    return [
        PageTable(
            (*heads, *DIFFERENCE[1:]), rows if conditions else [], "Success under other conditions, on the same seeds"
        ),
        secondary(
            metrics,
            ["condition"],
            f"Secondary metrics under other conditions, as the difference from {IN_DISTRIBUTION}",
        ),
        PageTable(
            ("tier", "success [%]", "episodes"), tiers, "Success by tier of difficulty", "" if seen.anytime else TIERS
        ),
        PageTable(("task", "success [%]", "episodes"), tasks, "Success by task"),
        PageTable(
            ("completed", "episodes [%]", "episodes"), completed, "Instructions completed in a row", _in_a_row(seen)
        ),
        PageTable(("milestone", "reached [%]", "episodes"), milestones, "Milestones", MILESTONES),
        PageTable(("", "median", "episodes"), motion, "Motion", MOTION),
    ]


TIERS = (
    "The mean over tiers weighs every tier alike, success every episode. The intervals here, and that of success, "
    "treat the tasks as given: only chance within a task counts."
)
MILESTONES = "Share of the episodes in which each milestone was reached, regardless of the outcome."
MOTION = (
    "Medians of the successful episodes, and their 95 % confidence intervals. Log jerk is the logarithm of the "
    "dimensionless jerk of the tool: 5.3 is the smoothest motion from rest to rest, every stop and tremor adds to it."
)


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


def _rounds_table(run: Run) -> PageTable:
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


def _changes_table(run: Run) -> PageTable | None:
    if run.changes is None:
        return None
    rows = [[code(each.key), value(each.here), value(each.default)] for each in run.changes]
    note = "" if rows else "There are none."
    return PageTable(("key", "here", "default"), rows, "Differences from the default configuration", note)
