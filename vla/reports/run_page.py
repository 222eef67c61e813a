"""The page of a run, `report.html`."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import quote

from vla.config.differences import value_at
from vla.data.index import INDEX, format_numbers, read_index
from vla.io.errors import counted
from vla.io.files import warn_on_error
from vla.reports.factors import episode_panels
from vla.reports.open_loop import errors_table
from vla.reports.page import Section, render
from vla.reports.pictures import GREEN, svgs
from vla.reports.result_tables import cells, conditions_table, rate_tables, secondary_table
from vla.reports.tables import Table, config_value, duration, in_words, links, percent
from vla.reports.training_curves import training_sections
from vla.rollouts.recordings import moving_pictures
from vla.rollouts.results import ERROR, Report, Result
from vla.runs.folder import EPISODES, ERRORS_PLOT, PAGE, RECORDING, RECORDINGS, SAMPLES, Run, read_run
from vla.spec import IN_DISTRIBUTION

MAX_TASKS, MAX_RECORDINGS = 5, 20  # maximum number of tasks in a title, and of recordings
ROLLOUTS = "Failures first, of every outcome the first ones; each picture shows a whole episode in five seconds."
PLAYED_NOTE = (
    "Outcomes, lengths, and, where only some succeed, success over the factors that it depends on most, with 95 % "
    "intervals; failures are red."
)
ROUNDS = "Each round plays episodes with improve.changes and trains on the expert's labels; validation plays others."
WINDOWS = "The newest images of each window, its instruction, and each component of the action within its range."


def try_write_page(folder: Path) -> Path | None:
    """Write the page of a run, see `write_page`; if that fails, warn and return None."""
    with warn_on_error(folder / PAGE):
        return write_page(folder)
    return None


def write_page(folder: Path) -> Path:
    """Write the page of a run from whatever files its folder has; return its path. A UserError names a damaged one."""
    run = read_run(folder)
    report = run.reports.get(IN_DISTRIBUTION)
    conditions = run.report.conditions if run.report else {}
    compared = {name: part.compared for name, part in conditions.items()}
    changes = [[change.key, config_value(change.here), config_value(change.default)] for change in run.changes or ()]
    parts = [
        Section("", facts=_facts(run)),
        *([errors_table(run.errors.components, len(run.errors.seeds))] if run.errors else []),
        Section("", picture=folder / ERRORS_PLOT if run.errors else None),
        _rounds(run),
        _rollouts(run),
        Section("Episodes", PLAYED_NOTE, panels=svgs(episode_panels(report)) if report else {}),
        *([conditions_table(run.reports, compared)] if conditions else []),
        secondary_table({(name,): metrics for name, metrics in compared.items() if run.reports[name] is not report}),
        *(rate_tables(report) if report else ()),
        *training_sections([(GREEN, run.metrics)]),
        Section("First training batch", WINDOWS, picture=folder / SAMPLES),
        *_origins(run),
        Table(("key", "here", "default"), changes, "Differences from the default configuration"),
    ]
    title = folder.resolve().name
    return render(
        folder / PAGE,
        " · ".join(filter(None, (run.policy, _tasks(run)))) or title,
        parts,
        any(part.anytime for part in run.reports.values()),
        subtitle=title,
        warning=_warning(run),
        rate=f"{percent(report.success)} %" if report else "",
        of=str(report).splitlines()[-1] if report else "",
    )


def _tasks(run: Run) -> str:
    """Return the names of the evaluated tasks, or how many there are; without any, the goal's or task's class."""
    classes = (str(value_at(run.config, key, "")).rpartition(".")[2] for key in ("task.goal._target_", "task._target_"))
    words = (re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower() for name in classes)
    tasks = [in_words(task) for task in run.tasks] or [*filter(None, words)][:1]
    return ", ".join(tasks) if len(tasks) <= MAX_TASKS else f"{len(tasks)} tasks"


def _warning(run: Run) -> str:
    """Return a sentence on how an incomplete training ended; "" if it was completed, or there was none."""
    if not (training := run.training) or training.ended == "done":
        return ""
    if training.ended != "interrupted":
        return f"Training failed: {training.ended}"
    is_round = re.fullmatch(r"round_\d+", run.folder.name) is not None
    path = _path(run.folder.parent if is_round else run.folder)
    steps = counted(training.steps, "step")
    return f"Training was interrupted after {steps}; resume={path} output={path} continues it."


def _path(path: Path, *folders: Path) -> Path:
    """Return a path relative to the first of the folders, and last the working directory, that contains it."""
    for folder in (*folders, Path.cwd()):
        if path.resolve().is_relative_to(folder.resolve()):
            return path.resolve().relative_to(folder.resolve())
    return path


def _facts(run: Run) -> dict[str, str]:
    """Return the facts at the top of a run's page: name → text."""
    training, report = run.training, run.report or run.errors
    facts = {f"statement {number}": text for number, text in enumerate(run.report.statements if run.report else (), 1)}
    if run.parameters is not None:
        facts["parameters"] = f"{run.parameters / 1e6:.2f} M"
    if report and report.latency_ms:
        facts["time per action"] = f"{report.latency_ms:.1f} ms"
    if training:
        facts["training"] = f"{counted(training.steps, 'step')} in {duration(training.seconds)}"
        keys = {"demonstrations": "collect.episodes", "and those in": "collect.more", "from weights of": "pretrained"}
        values = {name: value_at(run.config, key, None) for name, key in keys.items()}
        facts |= {name: config_value(value) for name, value in values.items() if value is not None}
    if report and report.seeds:
        seeds = counted(len(report.seeds), "seed" if run.report else "held-out episode")
        facts["evaluated on"] = f"{seeds}: {format_numbers(report.seeds)}"
    if report and report.checkpoint:
        facts["checkpoint"] = str(_path(Path(report.checkpoint), run.folder))
    return facts


def _rounds(run: Run) -> Table:
    """Tabulate the rounds with the expert that have a page, success before each, and the evaluation after them."""
    rows = []
    for page in sorted(run.folder.glob(f"round_*/{PAGE}"), key=lambda path: (len(path.parent.name), path)):
        entries, _ = read_index(page.parent / EPISODES / INDEX, any_seed=False, allow_damage=False)
        report = Report(tuple(Result(entry.seed, entry.outcome) for entry in entries if entry.is_stored))
        name, subrun = page.parent.name, read_run(page.parent)
        link = links({in_words(name): f"{quote(name)}/{PAGE}"})
        validation = percent(curve[1][-1]) if (curve := subrun.metrics.get("val/success")) else ""
        length = (str(subrun.training.steps), duration(subrun.training.seconds)) if subrun.training else ("", "")
        rows.append([link, *(cells(report.event_rate()) if report.results else ("", "")), validation, *length])
    if rows and run.report:
        rows.append(["evaluation", *cells(run.reports[IN_DISTRIBUTION].event_rate()), "", "", ""])
    heads = ("round", "success before it [%]", "episodes", "in validation after it [%]", "steps", "training")
    return Table(heads, rows, "Rounds with the expert", ROUNDS)


def _rollouts(run: Run) -> Section:
    """Return the moving pictures, what the recording contains, and how to record another episode."""
    results = [result for result in run.report.per_episode if result.outcome != ERROR] if run.report else []
    facts = dict[str, str]()
    if (run.folder / RECORDING).is_file() and run.report:
        seeds = {*run.report.recorded}
        counts = [
            f"{sum(result.seed in seeds for result in group)} of {counted(len(group), name)}"
            for name, good in (("failure", False), ("success", True))
            if (group := [result for result in results if result.success == good])
        ]
        facts["recording"] = links({RECORDING: RECORDING}) + f" has {' and '.join(counts)}; rerun {RECORDING} plays it"
        policy = f"agent={value_at(run.config, 'chosen.agent')}"
        policy = f"checkpoint={_path(Path(run.report.checkpoint))}" if run.report.checkpoint else policy
        command = f"python -m vla.run {policy} evaluate.seed=SEED evaluate.episodes=1 evaluate.recordings=all"
        facts["record another"] = command if run.training else f"{command}, and the task's options of the command below"
    if names := sorted(file.name for file in (run.folder / RECORDINGS).glob("*.rrd")):
        rest = f" and {len(names) - MAX_RECORDINGS} more in {RECORDINGS}" if len(names) > MAX_RECORDINGS else ""
        facts["single recordings"] = (
            links({name: f"{RECORDINGS}/{quote(name)}" for name in names[:MAX_RECORDINGS]}) + rest
        )
    return Section("Rollouts", ROLLOUTS, facts, rollouts=moving_pictures(results, run.folder / RECORDINGS))


def _origins(run: Run) -> list[Section]:
    """Return command line, commits and machine of each part of the work; a single section if all are alike."""
    stages, evaluation = run.training.origins if run.training else [], run.report or run.errors
    parts = {f" of the training{f', part {part}' if part > 1 else ''}": origin for part, origin in enumerate(stages, 1)}
    if evaluation and evaluation.origin:
        parts[" of the evaluation"] = evaluation.origin
    if len({str(origin) for origin in parts.values()}) == 1:
        parts = {"": next(iter(parts.values()))}
    sections = []
    for part, origin in parts.items():
        commits = ", ".join(f"{commit} ({tree})" for tree, commit in origin.commits.items())
        facts = {"command": origin.command, "git commit": commits, "host": origin.host, "processor": origin.processor}
        sections.append(Section(f"Origin{part}", facts={name: fact for name, fact in facts.items() if fact}))
    return sections
