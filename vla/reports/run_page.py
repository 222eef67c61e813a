"""The page of a run, `report.html`."""

from __future__ import annotations

import os
from pathlib import Path

from vla.config.differences import ABSENT, at
from vla.config.origin import Origin
from vla.data.index import listed
from vla.io.files import warn_on_error
from vla.reports.evaluation import factor_panels
from vla.reports.html import (
    PageTable,
    code,
    duration,
    in_words,
    render,
    value,
)
from vla.reports.index import INDEX, RUNS, Entry, write_index
from vla.reports.result_tables import condition_tables, error_table, rate_tables, rounds_table
from vla.reports.training_curves import draw_run
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
        UserError: a file is damaged.
    """
    run = read_run(folder)
    report = run.reports.get(IN_DISTRIBUTION, Report(()))
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
        tables=[table for table in (*condition_tables(run), *rate_tables(report)) if table.rows],
        report=report if run.report else None,
        panels=factor_panels(report),
        errors=error_table(run),
        rounds=rounds_table(run),
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


def _changes_table(run: Run) -> PageTable | None:
    if run.changes is None:
        return None
    rows = [[code(each.key), value(each.here), value(each.default)] for each in run.changes]
    note = "" if rows else "There are none."
    return PageTable(("key", "here", "default"), rows, "Differences from the default configuration", note)
