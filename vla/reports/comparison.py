"""Comparison of runs, every two of them, by their success under each condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from rich.table import Table

from vla.config.differences import at
from vla.config.nodes import conditions, with_changes
from vla.io.errors import UserError
from vla.reports.conditions import COMPARED, NARROW, SecondaryRows, short_texts
from vla.rollouts.comparison import Comparison, compare_pairs, compare_samples, concluded
from vla.rollouts.results import ERROR, Report, Result, concluded_secondary, pairs_of, secondary_of
from vla.rollouts.statistics import effective_episodes
from vla.runs.folder import Run, require_run
from vla.runs.sweep import SweepRow
from vla.spec import IN_DISTRIBUTION

CASE = ("second run", "minus first", "condition")  # heads of what was compared


@dataclass(frozen=True)
class RunComparison:
    """Comparison of two runs under a condition, in success and in secondary metrics of episodes that both played."""

    one: str
    other: str
    condition: str
    found: Comparison
    secondary: Mapping[str, Comparison] = field(default_factory=dict)  # milestone or field of `Motion` → the same


def read_runs(folders: Sequence[Path]) -> dict[str, Run]:
    """Return name → run.

    Raises:
        UserError: no folder is given, a folder is no run or given twice, or a file in it is damaged.
    """
    if not folders:
        raise UserError("name the runs to compare, as in report.runs=[RUN,RUN]")
    read = [require_run(folder) for folder in folders]
    return dict(zip(_names(folders), read, strict=True))


def _names(folders: Sequence[Path]) -> list[str]:
    """Return the shortest path suffixes of equal length that distinguish the folders."""
    paths = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(path[-length:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    raise UserError(f"a run is named twice: {', '.join(map(str, folders))}")


def compare_runs(runs: Mapping[str, Run], margin: float) -> list[RunComparison]:
    """Compare every two runs under each condition: on their common episodes, or without any on different ones.

    Runs in different worlds are not compared, nor conditions that repeat the training condition. Verdicts take all
    comparisons into account, those on secondary metrics separately.

    Args:
        runs: by name.
        margin: non-inferiority margin of the success rate, 0…1.
    """
    found = [
        RunComparison(one, other, condition, *compared)
        for one, other in combinations(runs, 2)
        for condition in runs[one].reports
        if not _repeats_training_condition((runs[one], runs[other]), condition)
        and (compared := _compared(runs[one], runs[other], condition))
    ]
    return _with_verdicts(found, margin)


def compare_rows(rows: Sequence[SweepRow], margin: float) -> list[RunComparison]:
    """Compare every row of a sweep with the first one under each condition, where both played the same scenes.

    Conditions that repeat the training condition are left out.

    Rows of one training each are compared as runs are: by paired tests, and in secondary metrics. Rows of several
    trainings are compared as independent samples of size `effective_episodes`, which ignores the pairing by scenes.

    Args:
        rows: of the sweep, at least one.
        margin: non-inferiority margin of the success rate, 0…1.
    """
    first, *others = rows
    found = [
        RunComparison(first.name, other.name, condition, *compared)
        for other in others
        for condition in first.played
        if condition in other.played
        and not _repeats_training_condition((*first.runs, *other.runs), condition)
        and (compared := _compared_rows(first, other, condition))
    ]
    return _with_verdicts(found, margin)


def _repeats_training_condition(runs: Sequence[Run], condition: str) -> bool:
    """Return whether a condition changes the task of none of the runs, so that its episodes are those of `seen`."""
    tasks = [(at(run.report.config, "task", {}), _changes(run, condition)) for run in runs if run.report]
    return all(changes is not None and with_changes(task, changes) == task for task, changes in tasks)


def compare_all_rows(rows: Sequence[SweepRow]) -> list[RunComparison]:
    """Compare every two rows in the training condition as `compare_rows` does, without verdicts."""
    return [
        RunComparison(one.name, other.name, IN_DISTRIBUTION, *compared)
        for one, other in combinations(rows, 2)
        if (compared := _compared_rows(one, other, IN_DISTRIBUTION))
    ]


def _with_verdicts(found: Sequence[RunComparison], margin: float) -> list[RunComparison]:
    """Return comparisons with verdicts on success, and separately on secondary metrics."""
    verdicts = concluded({number: each.found for number, each in enumerate(found)}, margin)
    secondary = concluded_secondary({number: each.secondary for number, each in enumerate(found)})
    return [replace(each, found=verdicts[number], secondary=secondary[number]) for number, each in enumerate(found)]


def _compared_rows(
    first: SweepRow, other: SweepRow, condition: str
) -> tuple[Comparison, Mapping[str, Comparison]] | None:
    """Compare two rows, see `compare_rows`; None in different worlds, or if one stopped when it was clear."""
    if any(run.reports[condition].anytime for row in (first, other) for run in row.runs if condition in run.reports):
        return None
    compared = _compared(first.runs[0], other.runs[0], condition)
    if compared is None or len(first.runs) == len(other.runs) == 1:
        return compared
    one, two = (_by_seed(row.runs[0], condition) for row in (first, other))
    if any(seed in two and scene != two[seed][1] for seed, (_, scene) in one.items()):
        return None  # effective numbers are of all episodes, of which some are other scenes
    (won, played), (others_won, others_played) = (effective_episodes(row.played[condition]) for row in (first, other))
    episodes = first.episodes[condition] + other.episodes[condition]
    return replace(compare_samples(won, played, others_won, others_played), episodes=episodes), {}


def remarks(runs: Mapping[str, Run], compared: Sequence[RunComparison]) -> list[str]:
    """Return sentences on the runs that are not compared and why, on libraries of different versions, and on episodes
    that ended in errors."""
    found = {(each.one, each.other) for each in compared}
    pairs = [f"{one} and {other}" for one, other in combinations(runs, 2) if (one, other) not in found]
    versions = [run.report.versions for run in runs.values() if run.report]
    libraries = dict.fromkeys(library for each in versions for library in each)
    versions_of = {each: dict.fromkeys(one[each] for one in versions if each in one) for each in libraries}
    other = [f"{library} {' and '.join(names)}" for library, names in versions_of.items() if len(names) > 1]
    failed = [
        f"{len(report.errors)} of {len(report.results)} in {name} ({condition})"
        for name, run in runs.items()
        for condition, report in run.reports.items()
        if report.errors
    ]
    return [
        *([f"not compared, because no episode is the same in both: {', '.join(pairs)}"] if pairs else []),
        *([f"evaluated with different versions: {', '.join(other)}"] if other else []),
        *([f"episodes that ended in errors, which count nowhere: {', '.join(failed)}"] if failed else []),
    ]


def runs_table(compared: Sequence[RunComparison]) -> Table:
    """Tabulate comparisons of runs."""
    table = Table(*CASE, "episodes", *COMPARED, **NARROW)
    for each in compared:
        table.add_row(each.other, each.one, each.condition, str(each.found.episodes), *short_texts(each.found))
    return table


def secondary_rows(compared: Sequence[RunComparison]) -> SecondaryRows:
    """Return second run, first run and condition → comparisons of secondary metrics."""
    return {(each.other, each.one, each.condition): each.secondary for each in compared if each.secondary}


def common_episodes(one: Run, other: Run, condition: str) -> list[tuple[Result, Result]]:
    """Return both results of every episode that two runs completed under a condition, in the order of seeds."""
    first, second = (_by_seed(run, condition) for run in (one, other))
    # The same seed gives another episode under another goal or level of randomisation.
    seeds = [seed for seed, (_, scene) in first.items() if seed in second and scene == second[seed][1]]
    return [(first[seed][0], second[seed][0]) for seed in sorted(seeds)]


def _compared(one: Run, other: Run, condition: str) -> tuple[Comparison, dict[str, Comparison]] | None:
    """Compare two runs under a condition, see `RunComparison`; None if they were evaluated in different worlds."""
    anytime = any(run.reports[condition].anytime for run in (one, other) if condition in run.reports)
    if together := common_episodes(one, other, condition):
        return compare_pairs(pairs_of(together), anytime), secondary_of(together, anytime)
    first, second = (_by_seed(run, condition) for run in (one, other))
    alike = _scenes(one, condition) == _scenes(other, condition) and not first.keys() & second.keys()
    if not (first and second and alike) or anytime:
        return None
    a, b = one.reports[condition], other.reports[condition]
    return compare_samples(a.successes, a.episodes, b.successes, b.episodes), {}


def _by_seed(run: Run, condition: str) -> dict[int, tuple[Result, Any]]:
    """Return seed → result under a condition, and a key that is equal for equal scene and instruction."""
    results = [result for result in run.reports.get(condition, Report(())).results if result.outcome != ERROR]
    if condition == IN_DISTRIBUTION:
        # A world may tell nothing of what it drew.
        scenes = _scenes(run, condition)
        return {result.seed: (result, (result.instruction, result.draws or scenes)) for result in results}
    return {result.seed: (result, _scenes(run, condition)) for result in results}


def _scenes(run: Run, condition: str) -> tuple[Any, ...]:
    """Return the config values that determine the scenes: the task, and the changes of a condition."""
    config = run.report.config if run.report else {}
    network = at(config, "evaluate.networks", {}).get(condition)
    distant = network and (network, at(config, "evaluate.by_clock", None))
    return at(config, "task"), _changes(run, condition), distant


def _changes(run: Run, condition: str) -> dict[str, Any] | None:
    """Return what a condition changes in the task; None if it is another agent's, or unknown."""
    evaluate = at(run.report.config if run.report else {}, "evaluate", {})
    return conditions(evaluate.get("conditions", {}), evaluate.get("one_by_one", {})).get(condition)
