"""Choice of the episodes of an evaluation to record, and of the recordings that stay in the folder of the run."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections import Counter
from collections.abc import Container, Iterable
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import Literal

from vla.rollouts.results import ERROR, Report, Result, recording_name

log = logging.getLogger(__name__)

# "all" episodes, the "failures" and a few successes, or a number of episodes, failures first.
Recordings = Literal["all", "failures"] | int

SUCCESSES = 10  # successes beside the failures
FAILURES_SHOWN, SUCCESSES_SHOWN = 6, 3  # moving pictures
# Limits of a file, [bytes] and recordings: merging takes seven times its size in memory.
MAX_BYTES, MAX_RECORDINGS = 1 << 29, 2000
SUFFIXES = (".rrd", ".webp")  # of a recording and of a moving picture


def choose_results(report: Report, recordings: Recordings) -> list[Result]:
    """Return the episodes that `recordings` selects: failures first, in the order of their seeds."""
    results = sorted((result for result in report.results if result.outcome != ERROR), key=lambda result: result.seed)
    failures, successes = ([result for result in results if result.success == good] for good in (False, True))
    if recordings == "failures":
        return failures + successes[:SUCCESSES]
    return (failures + successes)[: None if recordings == "all" else recordings]


def moving_pictures(results: Iterable[Result], folder: Path) -> list[tuple[Result, Path]]:
    """Return the results whose moving pictures in a folder are shown: the first failures, then the first successes.

    Failures cycle through the outcomes.
    """
    files = {path.stem: path for path in folder.glob("*.webp")}  # listed, because outcomes may come from a report
    counts, places = Counter[str](), list[tuple[int, Result, Path]]()
    for result in sorted(results, key=lambda result: result.seed):
        if file := files.get(recording_name(result.seed, result.outcome)):
            places.append((counts[result.outcome], result, file))
            counts[result.outcome] += 1
    pairs = [(result, file) for _, result, file in sorted(places, key=lambda place: place[0])]
    failures, successes = ([pair for pair in pairs if pair[0].success == good] for good in (False, True))
    return failures[:FAILURES_SHOWN] + successes[:SUCCESSES_SHOWN]


def clear_recordings(folder: Path, keep: Container[Path] = ()) -> None:
    """Remove the recordings and moving pictures in a folder except those in `keep`."""
    for file in folder.glob("*"):
        if file.suffix in SUFFIXES and file not in keep:
            file.unlink()


def merge_recordings(report: Report, folder: Path, target: Path, recordings: Recordings) -> list[int]:
    """Merge the recordings that `recordings` selects into one file, failures first; return their seeds.

    Those beyond `MAX_BYTES` or `MAX_RECORDINGS` stay single files, which is logged.
    """
    from vla.rollouts.recorder import merge  # imports the viewer's library

    names = {result.seed: recording_name(result.seed, result.outcome) for result in choose_results(report, recordings)}
    files = {seed: folder / f"{name}.rrd" for seed, name in names.items()}
    seeds = [seed for seed, file in files.items() if file.exists()]
    sizes = accumulate(files[seed].stat().st_size for seed in seeds)
    merged = seeds[: max(1, min(MAX_RECORDINGS, bisect_right([*sizes], MAX_BYTES)))]
    if merged:
        merge([files[seed] for seed in merged], target)
    if rest := len(seeds) - len(merged):
        log.info("%s has %d recordings, the %d others stay in %s", target, len(merged), rest, folder)
    return merged


def keep_pictures(report: Report, folder: Path, recordings: Recordings, merged: Container[int]) -> None:
    """Keep the recordings that `recordings` selects and that were not `merged`, and the `moving_pictures` of selected
    ones; remove all others, and the folder if it is then empty."""
    results = choose_results(report, recordings)
    paths = {file for _, file in moving_pictures(results, folder)}
    unmerged = (result for result in results if result.seed not in merged)
    clear_recordings(
        folder, paths | {folder / f"{recording_name(result.seed, result.outcome)}.rrd" for result in unmerged}
    )
    with suppress(OSError):
        folder.rmdir()
