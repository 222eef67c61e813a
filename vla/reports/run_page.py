"""The page of a run, `report.html`."""

from __future__ import annotations

from pathlib import Path

from vla.config.differences import ABSENT, at
from vla.data.index import listed
from vla.reports.factors import episode_panels
from vla.reports.open_loop import errors_table
from vla.reports.page import Section, render
from vla.reports.pictures import GREEN, svgs
from vla.reports.result_tables import conditions_table, rate_tables, secondary_table
from vla.reports.tables import Table, config_value, duration, in_words, links, percent
from vla.reports.training_curves import training_sections
from vla.rollouts.recordings import pictured, shown
from vla.rollouts.results import ERROR
from vla.runs.folder import ERRORS_PLOT, PAGE, RECORDING, RECORDINGS, SAMPLES, Run, read_run
from vla.spec import IN_DISTRIBUTION

NAMED = 5  # maximum number of tasks in a title
ROLLOUTS = "Failures first, of every outcome the first ones; each picture shows a whole episode in five seconds."
EPISODES = (
    "Outcomes, lengths, and, where only some succeed, success over the factors that it depends on most, with 95 % "
    "intervals; failures are red."
)
WINDOWS = "The newest images of each window, its instruction, and each component of the action within its range."


def write_page(folder: Path) -> Path:
    """Write the page of a run from the files in its folder, and return its path; missing files are omitted.

    Raises a UserError if a file is damaged.
    """
    run = read_run(folder)
    report = run.reports.get(IN_DISTRIBUTION)
    others = run.report.conditions if run.report else {}
    compared = {name: part.compared for name, part in others.items()}
    changes = [[each.key, config_value(each.here), config_value(each.default)] for each in run.changes or ()]
    parts = [
        Section("", facts=_facts(run)),
        *([errors_table(run.errors.components, len(run.errors.seeds))] if run.errors else []),
        Section("", picture=folder / ERRORS_PLOT if run.errors else None),
        _rollouts(run),
        Section("Episodes", EPISODES, panels=svgs(episode_panels(report)) if report else {}),
        *([conditions_table(run.reports, compared)] if others else []),
        secondary_table({(name,): found for name, found in compared.items()}),
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
        any(each.anytime for each in run.reports.values()),
        subtitle=title,
        warning=_ended(run),
        rate=f"{percent(report.success)} %" if report else "",
        of=str(report).splitlines()[-1] if report else "",
    )


def _tasks(run: Run) -> str:
    """Return the names of the evaluated tasks, or how many there are; without any, the class of the goal or task."""
    classes = (str(at(run.config, key, "")).rpartition(".")[2] for key in ("task.goal._target_", "task._target_"))
    tasks = [in_words(task) for task in run.tasks] or [*filter(None, classes)][:1]
    return ", ".join(tasks) if len(tasks) <= NAMED else f"{len(tasks)} tasks"


def _ended(run: Run) -> str:
    """Return a sentence on how an incomplete training ended; "" if it was completed, or there was none."""
    if not run.training or run.training.ended == "done":
        return ""
    if run.training.ended != "interrupted":
        return f"Training failed: {run.training.ended}"
    return f"Training was interrupted after {run.training.steps} steps; resume={_near(run.folder)} continues it."


def _near(path: Path, *folders: Path) -> Path:
    """Return a path relative to the first of the folders, and last the working directory, that contains it."""
    for folder in (*folders, Path.cwd()):
        if path.resolve().is_relative_to(folder.resolve()):
            return path.resolve().relative_to(folder.resolve())
    return path


def _facts(run: Run) -> dict[str, str]:
    """Return the facts at the top of a run's page: name → text."""
    training, report = run.training, run.report or run.errors
    facts = {f"statement {number}": each for number, each in enumerate(run.report.statements if run.report else (), 1)}
    if run.parameters is not None:
        facts["parameters"] = f"{run.parameters / 1e6:.2f} M"
    if report and report.latency_ms:
        facts["time per action"] = f"{report.latency_ms:.1f} ms"
    if training:
        facts["training"] = f"{training.steps} steps in {duration(training.seconds)}"
    if training and (demonstrations := at(run.config, "collect.episodes")) != ABSENT:
        facts["demonstrations"] = str(demonstrations)
    if report and report.seeds:
        seeds = f"seeds {min(report.seeds)} to {max(report.seeds)}"
        facts["evaluated on"] = seeds if run.report else f"the held-out episodes {listed(report.seeds)}"
    if report and report.checkpoint:
        facts["checkpoint"] = str(_near(Path(report.checkpoint), run.folder))
    return facts


def _rollouts(run: Run) -> Section:
    """Return the moving pictures, what the recording contains, and how to record another episode."""
    results = [each for each in run.report.per_episode if each.outcome != ERROR] if run.report else []
    pictures, facts = pictured(results, run.folder / RECORDINGS), dict[str, str]()
    if (run.folder / RECORDING).is_file() and run.report:
        recorded = {*run.report.recorded}
        counts = [
            f"{sum(each.seed in recorded for each in played)} of {len(played)} {name}"
            for name, good in (("failures", False), ("successes", True))
            if (played := [each for each in results if each.success == good])
        ]
        facts["recording"] = links({RECORDING: RECORDING}) + f" has {' and '.join(counts)}; rerun {RECORDING} plays it"
        policy = f"checkpoint={_near(Path(run.report.checkpoint))} " if run.report.checkpoint else ""
        command = f"python -m vla.run {policy}evaluate.seed=SEED evaluate.episodes=1 evaluate.recordings=all"
        facts["record another"] = command
    moving = shown(each for each in results if each.seed in pictures)
    return Section("Rollouts", ROLLOUTS, facts, rollouts=[(each, pictures[each.seed]) for each in moving])


def _origins(run: Run) -> list[Section]:
    """Return command line, commits and machine of each part of the work; a single section if all are alike."""
    begun, evaluated = run.training.origins if run.training else [], run.report or run.errors
    known = {f" of the training{f', part {part}' if part > 1 else ''}": each for part, each in enumerate(begun, 1)}
    if evaluated and evaluated.origin:
        known[" of the evaluation"] = evaluated.origin
    if len({str(origin) for origin in known.values()}) == 1:
        known = {"": next(iter(known.values()))}
    sections = []
    for part, origin in known.items():
        commits = ", ".join(f"{commit} ({tree})" for tree, commit in origin.commits.items())
        facts = {"command": origin.command, "git commit": commits, "host": origin.host, "processor": origin.processor}
        sections.append(Section(f"Origin{part}", facts={name: fact for name, fact in facts.items() if fact}))
    return sections
