"""Comparison of runs, and of the rows of a sweep, by their success under each condition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

from vla.config.differences import value_at
from vla.config.nodes import with_changes
from vla.io.errors import UserError
from vla.reports.result_tables import secondary_table
from vla.reports.tables import DIFFERENCE, Table, difference
from vla.rollouts.comparison import SUCCESS, Comparison, compare_results, compare_samples, conclude_cases
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.statistics import effective_episodes
from vla.runs.folder import Run, require_run
from vla.runs.sweep import SweepRow
from vla.spec import IN_DISTRIBUTION

# Names of the second row, of the first one, and condition → what is compared → comparison.
Comparisons = Mapping[tuple[str, ...], Mapping[str, Comparison]]
CASE = ("second", "minus first", "condition")
PICTURES = ("image_size", "renderer", "cameras", "detail")  # keys of a task that change its pictures, not its scenes


def read_runs(folders: Sequence[Path]) -> dict[str, Run]:
    """Return name → run; raise a UserError if no folder is given, or one twice, or one is no run or is damaged."""
    if not folders:
        raise UserError("name the runs to compare, as in report.runs=[RUN,RUN]")
    runs = [require_run(folder) for folder in folders]
    paths = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, paths)) + 1):  # the shortest ends of their paths that tell them apart
        names = ["/".join(path[-length:]) for path in paths]
        if len(set(names)) == len(names):
            return dict(zip(names, runs, strict=True))
    raise UserError(f"a run is named twice: {', '.join(map(str, folders))}")


def rows_of(runs: Mapping[str, Run]) -> list[SweepRow]:
    """Return a row per run, by its name."""
    return [SweepRow({"run": name}, [run]) for name, run in runs.items()]


def compare(pairs: Iterable[tuple[SweepRow, SweepRow]], margin: float) -> Comparisons:
    """Compare pairs of rows under each condition that both played in the same world.

    Single trainings are compared on the episodes that both played, by paired tests and in secondary metrics; without
    any, and with several trainings, as independent samples of size `effective_episodes`. Conditions that repeat the
    training condition are left out. Verdicts take all comparisons into account, those on secondary metrics separately;
    `margin`, 0…1, is how much less success counts as not worse.
    """
    comparisons: dict[tuple[str, ...], dict[str, Comparison]] = {
        (other.name, one.name, condition): metrics
        for one, other in pairs
        for condition in one.successes
        if condition in other.successes
        and not _repeats_training_condition((*one.runs, *other.runs), condition)
        and (metrics := _compare_rows(one, other, condition))
    }
    return conclude_cases(comparisons, margin)


def _repeats_training_condition(runs: Sequence[Run], condition: str) -> bool:
    """Return whether a condition changes the task of none of the runs, so that its episodes are those of `seen`."""
    reports = [run.reports for run in runs if condition in run.reports]
    return condition != IN_DISTRIBUTION and all(each[condition] is each[IN_DISTRIBUTION] for each in reports)


def _compare_rows(one: SweepRow, other: SweepRow, condition: str) -> dict[str, Comparison]:
    """Compare two rows under a condition, see `compare`; empty if worlds differ, or samples stopped early."""
    runs = one.runs[0], other.runs[0]
    reports = [run.reports[condition] for row in (one, other) for run in row.runs if condition in run.reports]
    anytime = any(report.anytime for report in reports)
    if len(one.runs) == len(other.runs) == 1 and (together := common_episodes(*runs, condition)):
        return compare_results(together, anytime)
    first, second = (_by_seed(run, condition) for run in runs)
    if common_seeds := first.keys() & second.keys():  # then each of them must be of the same world in both samples
        same_world = all(first[seed][1] == second[seed][1] for seed in common_seeds)
    else:
        same_world = _scenes(runs[0], condition) == _scenes(runs[1], condition)
    if anytime or not (first and second and same_world):
        return {}
    samples = [effective_episodes(row.successes[condition]) for row in (one, other)]
    episodes = one.episodes[condition] + other.episodes[condition]
    return {SUCCESS: replace(compare_samples(*samples[0], *samples[1]), episodes=episodes)}


def remarks(runs: Mapping[str, Run], comparisons: Comparisons | None = None) -> dict[str, str]:
    """Return remark → the names of the runs that it concerns; given comparisons, also the pairs that have none."""
    compared_pairs = dict.fromkeys((one, other) for other, one, _ in comparisons or ())
    played = [] if comparisons is None else [name for name, run in runs.items() if run.report]
    pairs = [pair for pair in combinations(played, 2) if pair not in compared_pairs]
    conditions_left_out = [
        f"{one} and {other} ({condition})"
        for one, other in compared_pairs
        for condition in runs[one].reports
        if condition in runs[other].reports
        and (other, one, condition) not in (comparisons or ())
        and not _repeats_training_condition((runs[one], runs[other]), condition)
    ]
    versions: dict[str, dict[str, None]] = {}  # library → its versions, in order and without repetition
    for run in runs.values():
        for library, version in run.report.versions.items() if run.report else ():
            versions.setdefault(library, {})[version] = None
    failures = [
        f"{len(report.errors)} of {len(report.results)} in {name} ({condition})"
        for name, run in runs.items()
        for condition, report in run.reports.items()
        if report.errors
    ]
    names_by_remark = {
        "not compared, because no episode was played": [
            name for name, run in runs.items() if comparisons is not None and not run.report
        ],
        "not compared, because no episode is the same in both": [f"{one} and {other}" for one, other in pairs],
        "not compared under a condition, because its worlds differ": conditions_left_out,
        "evaluated with different versions": [f"{n} {' and '.join(v)}" for n, v in versions.items() if len(v) > 1],
        "episodes that ended in errors, which count nowhere": failures,
    }
    return {remark: ", ".join(names) for remark, names in names_by_remark.items() if names}


def difference_tables(comparisons: Comparisons) -> list[Table]:
    """Tabulate comparisons of success, and those of milestones and motion."""
    details, rows = ("only the first succeeds", "only the second succeeds"), []
    for case, metrics in comparisons.items():
        comparison = metrics[SUCCESS]
        counts = ["" if count is None else str(count) for count in (comparison.only_first, comparison.only_second)]
        rows.append([*case, str(comparison.episodes), *counts, *difference(comparison)])
    note = (
        "Rows with numbers of episodes in which only one succeeds compare the episodes that both played; other rows "
        "compare different episodes of the same world, or several trainings."
    )
    heads = (*CASE, "episodes", *details, *DIFFERENCE)
    return [Table(heads, rows, "Differences in success", note, (*details, "p")), secondary_table(comparisons, CASE)]


def common_episodes(one: Run, other: Run, condition: str) -> list[tuple[Result, Result]]:
    """Return both results of every episode that two runs completed under a condition, in the order of seeds."""
    first, second = (_by_seed(run, condition) for run in (one, other))
    # The same seed gives another episode under another goal or level of randomisation.
    seeds = [seed for seed, (_, scene) in first.items() if seed in second and scene == second[seed][1]]
    return [(first[seed][0], second[seed][0]) for seed in sorted(seeds)]


def _by_seed(run: Run, condition: str) -> dict[int, tuple[Result, Any]]:
    """Return seed → result under a condition, and a key that is equal for equal scene and instruction.

    For other conditions than the first, and for some worlds, only the config tells what was drawn.
    """
    results, scenes = run.reports.get(condition, Report(())).results, _scenes(run, condition)
    return {
        each.seed: (each, (each.episode, None if each.draws else scenes)) for each in results if each.outcome != ERROR
    }


def _scenes(run: Run, condition: str) -> tuple[Any, ...]:
    """Return the config values that determine the scenes: the task with the changes of a condition, and its network."""
    config, changes = run.report.config if run.report else {}, _changes(run, condition)
    world = value_at(config, "task")
    if isinstance(world, dict):
        world = {name: value for name, value in with_changes(world, changes or {}).items() if name not in PICTURES}
    return world, changes is None, value_at(config, "evaluate.networks", {}).get(condition)


def _changes(run: Run, condition: str) -> dict[str, Any] | None:
    """Return what a condition changes in the task; None if it changes the agent, or is unknown."""
    return run.report.changes.get(condition) if run.report else None
