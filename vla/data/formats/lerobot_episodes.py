"""Episodes of a LeRobot dataset: where their steps are, and which instruction each step has.

The rows of an episode are those with its number, in whichever file. Files that metadata name, and numbers of rows, may
be out of date after episodes were merged or deleted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.lerobot_tables import MEND, REMEDY, counts, numbers
from vla.data.index import listed
from vla.io.errors import UserError
from vla.spec import LONGEST_INSTRUCTION, Array

OWNER, TASK, TIME, FROM, TO = "episode_index", "task_index", "timestamp", "dataset_from_index", "dataset_to_index"
UNNAMED = "__index_level_0__"  # column of an index that pandas writes without a name


@dataclass(frozen=True)
class Part:
    """Consecutive steps of an episode that have one instruction: all of them, unless its task changes.

    Attributes:
        episode: its number in the dataset.
        rows: those of the whole episode in the tables, (N,).
        files: that hold these rows.
        steps: of the part, among those of the episode.
        instruction: of the part.
        time: stamp of the first step of the episode [s].
        place: files and times of the episode's videos, a row of `meta/episodes`.
    """

    episode: int
    rows: Array
    files: tuple[Path, ...]
    steps: slice
    instruction: str
    time: float
    place: Mapping[str, Any]


def read_parts(folder: Path, info: layout.Info, videos: Sequence[str]) -> list[Part]:
    """Return the parts of all episodes, in order, with the places of the `videos`, keys of features.

    Raises:
        UserError: a table is missing or damaged, rows or episodes are missing, or time stamps do not follow the rate.
    """
    episodes, instructions = _read_episodes(folder, info, videos), _read_instructions(folder / layout.TASKS)
    paths = tables.files(folder / "data")
    rows = tables.read(paths, {OWNER: counts, TASK: counts, TIME: numbers})
    file = np.repeat(np.arange(len(paths)), [pq.read_metadata(path).num_rows for path in paths])
    owner, tasks, stamps = rows[OWNER].to_numpy(), rows[TASK].to_numpy(), tables.matrix(rows[TIME], 1, np.float64)
    if stamps is None:
        raise UserError(f"{folder}/data has rows of {TIME} that are not one number: {MEND}")
    require_finite(folder, TIME, stamps, owner)
    times = stamps[:, 0]
    order, index = np.argsort(owner, kind="stable"), [row[OWNER] for row in episodes]
    first, stop = (np.searchsorted(owner[order], index, side) for side in ("left", "right"))
    found = list[Part]()
    for row, there in zip(episodes, map(slice, first, stop), strict=True):
        steps, number = order[there], row[OWNER]
        _require_whole(folder, row, len(steps))
        _require_even(folder, info.fps, number, times[steps] - times[steps[0]])
        files = tuple(paths[each] for each in np.unique(file[steps]))
        changes = np.flatnonzero(np.diff(tasks[steps])) + 1
        for start, end in pairwise([0, *changes.tolist(), len(steps)]):
            if (instruction := instructions.get(int(tasks[steps[start]]))) is None:
                task = tasks[steps[start]]
                raise UserError(f"{folder / layout.TASKS} lacks task {task}, which episode {number} has: {MEND}")
            found.append(Part(number, steps, files, slice(start, end), instruction, float(times[steps[0]]), row))
    return found


def _read_episodes(folder: Path, info: layout.Info, videos: Sequence[str]) -> list[dict[str, Any]]:
    """Return the rows of `meta/episodes`, in the order of the episodes."""
    columns = dict.fromkeys((OWNER, FROM, TO), counts)
    for video in (f"videos/{key}" for key in videos):
        columns |= {f"{video}/chunk_index": counts, f"{video}/file_index": counts}
        columns |= {f"{video}/from_timestamp": tables.times, f"{video}/to_timestamp": tables.times}
    found = tables.read(tables.files(folder / "meta/episodes"), columns).sort_by(OWNER).to_pylist()
    if twice := [one[OWNER] for one, other in pairwise(found) if one[OWNER] == other[OWNER]]:
        raise UserError(f"{folder}/meta/episodes lists episode {twice[0]} more than once: {MEND}")
    there = {"episodes": len(found), "frames": sum(row[TO] - row[FROM] for row in found)}
    for what, total in (("episodes", info.total_episodes), ("frames", info.total_frames)):
        if there[what] < total:
            raise UserError(
                f"{folder}/meta/episodes lists {there[what]} of the {total} {what} that meta/info.json counts: {REMEDY}"
                f", or correct total_{what} there if the others were left out on purpose"
            )
    if not found:
        raise UserError(f"{folder} has no episodes: record some first")
    return found


def _read_instructions(path: Path) -> dict[int, str]:
    """Return task index → instruction; the name of the column of instructions depends on the writer."""
    schema = tables.schema_of(path)
    texts = [each.name for each in schema if pa.types.is_string(each.type) or pa.types.is_large_string(each.type)]
    known = [name for name in (UNNAMED, "task") if name in texts] or (texts if len(texts) == 1 else [])
    if not known:
        raise UserError(f"{path} has the columns {', '.join(schema.names)[:200]}, none of them task with texts: {MEND}")
    table = tables.read([path], {TASK: counts, known[0]: tables.texts})
    found = dict(zip(table[TASK].to_pylist(), table[known[0]].to_pylist(), strict=True))
    if longer := [index for index, text in found.items() if len(text) > LONGEST_INSTRUCTION]:
        raise UserError(f"{path} has tasks of more than {LONGEST_INSTRUCTION} characters: {listed(longer)}")
    return found


def require_finite(folder: Path, name: str, values: Array, owner: Array) -> None:
    """Require the rows (N, D) of a feature to be finite; `owner` (N,) are their episodes.

    Raises:
        UserError: some are not; the message names the episode and the step of the first one.
    """
    if len(wrong := np.argwhere(~np.isfinite(values))):
        row, at = wrong[0]
        step, others = (owner[:row] == owner[row]).sum(), len(set(wrong[:, 0])) - 1
        more = f", as in {others} other steps" if others else ""
        raise UserError(
            f"{folder}: {name} is {values[row, at]} at index {at} in episode {owner[row]}, step {step}{more}: correct "
            "the numbers, or delete the episodes with lerobot-edit-dataset"
        )


def _require_whole(folder: Path, row: Mapping[str, Any], there: int) -> None:
    """Require the rows of an episode, `there` in number, to be as many as its metadata, `row`, count."""
    steps, number = row[TO] - row[FROM], row[OWNER]
    if there < steps:
        raise UserError(f"{folder}/data holds {there} of the {steps} steps of episode {number}: {REMEDY}")
    if there > steps or not steps:
        raise UserError(
            f"{folder}/data holds {there} steps of episode {number}, for which meta/episodes counts {steps}: {MEND}"
        )


def _require_even(folder: Path, fps: float, number: int, times: Array) -> None:
    """Require the times of an episode, those since its first step, to follow the rate, without gaps."""
    steps = np.arange(len(times))
    off = np.abs(times - steps / fps) > (0.5 + layout.RATE_TOLERANCE * steps) / fps
    off |= np.abs(np.diff(times, prepend=-1 / fps) - 1 / fps) > 0.5 / fps  # a step that was left out
    if off.any():
        step = int(np.argmax(off))
        raise UserError(
            f"{folder}: step {step} of episode {number} comes {times[step]:.4g} s after its first one, but at {fps:g} "
            f"Hz, the rate in meta/info.json, it is {step / fps:.4g} s: correct fps there, or record all episodes at "
            "one rate without gaps"
        )
