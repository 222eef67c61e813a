"""The index of an episode store: one line of JSON per tried seed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vla.spec import Array

REMEDY = "copy the folder again from where it is whole, or delete it and collect again"
SALVAGE = f"keep what is whole with job=inspect inspect.repair=true, {REMEDY}"
DAMAGED = "damaged"  # outcome of a seed whose episode could not be kept by a repair
LOST = "lost"  # outcome of a seed of which a damaged index tells nothing
MOMENTS = {"low", "high", "sum", "square"}  # of the actions of an episode


@dataclass(frozen=True)
class Entry:
    """One index line: a seed that was tried; one that failed has no steps."""

    seed: int
    outcome: str  # "success" or the name of the failure
    instruction: str
    start: int  # first row of the episode in every field file
    steps: int
    draws: dict[str, Any]  # randomisation axis → what was drawn
    crc: int  # CRC-32 of the rows of all fields, in the order of `fields_of`; of JPEG, of the files
    action: dict[str, list[float]]  # "low" | "high" | "sum" | "square" → (D,) over the steps; empty for failures

    @property
    def success(self) -> bool:
        """Whether the episode is stored."""
        return self.outcome == "success"


def moments(actions: Array) -> dict[str, list[float]]:
    """What an entry keeps of the actions (N, D) of its episode."""
    wide = actions.astype(np.float64)
    values = {"low": wide.min(0), "high": wide.max(0), "sum": wide.sum(0), "square": (wide**2).sum(0)}
    return {name: value.tolist() for name, value in values.items()}


def index_line(entry: Entry) -> bytes:
    """An entry as the index has it."""
    return (dumps(asdict(entry)) + "\n").encode()


def dumps(value: Any) -> str:
    """JSON on one line, with arrays as lists; a ValueError for what is none of numbers, strings, lists and dicts."""
    return json.dumps(value, default=_plain, allow_nan=False, ensure_ascii=False)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise ValueError(f"an episode store keeps numbers, strings, lists and dicts, not {value!r}")


def read_index(path: Path, any_seed: bool, damaged: bool) -> tuple[list[Entry], int]:
    """The entries and the number of bytes they take: a last line that was cut short does not count.

    Unless `any_seed`, seeds are consecutive, so that it can be told which are `LOST` in a damaged index.
    """
    remedy = REMEDY if any_seed else SALVAGE
    entries: list[Entry] = []
    size = rows = last = 0
    lines = path.read_bytes().split(b"\n") if path.exists() else [b""]
    for number, line in enumerate(lines[:-1], start=1):
        try:
            entry = _entry(line)
        except (ValueError, TypeError) as error:
            if number == len(lines) - 1:
                break
            if damaged and not any_seed:
                continue
            raise ValueError(f"line {number} of {path} cannot be read: {remedy}") from error
        before = entries[-1].seed if entries else entry.seed - number
        if entry.start != rows or (entry.seed != before + 1 and not any_seed):
            if not damaged or any_seed:
                raise ValueError(f"line {number} of {path} does not follow the line before it: {remedy}")
            if not 1 <= entry.seed - before <= number - last + 1:  # a lost line end makes one line of two
                continue
            entries += [Entry(seed, LOST, "", rows, 0, {}, 0, {}) for seed in range(max(before + 1, 0), entry.seed)]
        entries.append(entry)
        rows, size, last = entry.start + entry.steps, size + len(line) + 1, number
    return entries, size


def _entry(line: bytes) -> Entry:
    entry = Entry(**json.loads(line))
    counts = (entry.seed, entry.start, entry.steps, entry.crc)
    if not all(type(count) is int and count >= 0 for count in counts) or (
        entry.success and set(entry.action) != MOMENTS
    ):
        raise ValueError("its numbers are no counts, or some are missing")
    return entry
