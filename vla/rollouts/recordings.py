"""Which episodes of an evaluation are recorded, and what stays of their recordings in the folder of the run."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from vla.rollouts.results import ERROR, Report, Result

log = logging.getLogger(__name__)

# "all" episodes, the "failures" and a few successes, or so many episodes, failures first.
Recordings = Literal["all", "failures"] | int

SUCCESSES = 10  # successes beside the failures
FAILURES_SHOWN, SUCCESSES_SHOWN = 6, 3  # moving pictures
SUFFIXES = (".rrd", ".webp")  # of a recording and of a moving picture


class _Ended(Protocol):
    @property
    def seed(self) -> int: ...
    @property
    def outcome(self) -> str: ...


E = TypeVar("E", bound=_Ended)


def chosen(report: Report, wanted: Recordings) -> list[Result]:
    """Return the episodes whose recordings are `wanted`: failures first, in the order of their seeds."""
    ended = sorted((result for result in report.results if result.outcome != ERROR), key=lambda result: result.seed)
    failures, successes = ([each for each in ended if each.success == good] for good in (False, True))
    if wanted == "failures":
        return failures + successes[:SUCCESSES]
    return (failures + successes)[: None if wanted == "all" else wanted]


def shown(episodes: Iterable[E], failures: int = FAILURES_SHOWN, successes: int = SUCCESSES_SHOWN) -> list[E]:
    """Return the first failures, then the first successes; failures cycle through the outcomes."""
    earlier, places = Counter[str](), list[tuple[int, E]]()
    for each in sorted(episodes, key=lambda each: each.seed):
        places.append((earlier[each.outcome], each))
        earlier[each.outcome] += 1
    ordered = [each for _, each in sorted(places, key=lambda place: place[0])]
    failed, succeeded = ([each for each in ordered if (each.outcome == "success") == good] for good in (False, True))
    return failed[:failures] + succeeded[:successes]


def clear(folder: Path) -> None:
    """Remove the recordings and moving pictures in a folder, those of an earlier evaluation."""
    for file in folder.glob("*"):
        if file.suffix in SUFFIXES:
            file.unlink()


def keep_recordings(
    report: Report, folder: Path, target: Path, wanted: Recordings, continues: bool = False
) -> list[int]:
    """Merge the `wanted` recordings of an evaluation into one file, failures first; return their seeds.

    Unless the evaluation `continues`, only the moving pictures of the episodes to be `shown` stay in the folder, which
    is removed if it is empty.
    """
    from vla.rollouts.recorder import merge, recording_name  # imports the viewer's library

    files = {result.seed: folder / recording_name(result.seed, result.outcome) for result in chosen(report, wanted)}
    recorded = [seed for seed, file in files.items() if file.with_suffix(".rrd").exists()]
    if recorded:
        merge([files[seed].with_suffix(".rrd") for seed in recorded], target)
    if not continues:
        pictured = [
            each for each in report.results if each.seed in files and files[each.seed].with_suffix(".webp").exists()
        ]
        kept = {files[each.seed].with_suffix(".webp") for each in shown(pictured)}
        for file in folder.glob("*"):
            if file.suffix in SUFFIXES and file not in kept:
                file.unlink()
        with suppress(OSError):
            folder.rmdir()
    return recorded
