"""The index of an episode store: one line of JSON per tried seed, which ends with a checksum of itself."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, MaxLen, Predicate

from vla.documents import STRICT, parse_json
from vla.spec import LONGEST_INSTRUCTION, Name
from vla.types import Seed

REMEDY = "copy the folder again from where it is whole, or delete it and collect again"
SALVAGE = f"keep what is whole with job=inspect inspect.repair=true, {REMEDY}"
DAMAGED = "damaged"  # outcome of a seed whose episode could not be kept by a repair
LOST = "lost"  # outcome of a seed of which a damaged index tells nothing
CHECK = b', "check": '  # before the CRC-32 of the line without it, which is the last in every line
LISTED = 8  # numbers in a sentence


def moderate(value: Any) -> bool:
    """with numbers within 2^63 only, so neither NaN nor infinity"""
    if isinstance(value, (dict, list)):
        return all(map(moderate, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, (int, float)) or abs(value) <= 2**63


Plain = Annotated[dict[str, Any], Predicate(moderate)]  # out of JSON
Offset = Annotated[int, Ge(0), Le(2**53)]
Crc = Annotated[int, Ge(0), Le(2**32 - 1)]


@dataclass(frozen=True)
class Entry:
    """One index line: a seed that was tried; one that failed has no steps."""

    __pydantic_config__ = STRICT

    seed: Seed
    outcome: Name  # "success" or the name of the failure
    instruction: Annotated[str, MaxLen(LONGEST_INSTRUCTION)]
    start: Offset  # first row of the episode in every field file
    steps: Offset
    draws: Plain  # randomisation axis → what was drawn
    crc: dict[str, Crc]  # field → CRC-32 of its rows; of JPEG, of the files; empty for failures

    @property
    def success(self) -> bool:
        """Whether the episode is stored."""
        return self.outcome == "success"


def index_line(entry: Entry) -> bytes:
    """An entry as the index has it."""
    return _sealed(dumps(asdict(entry)).encode()) + b"\n"


def parse_line(line: bytes, name: str) -> Entry:
    """The entry of a line without its end; a ValueError that begins with `name` if it is not what was written."""
    body = line.rpartition(CHECK)[0] + b"}"
    if _sealed(body) != line:
        raise ValueError(f"{name} is damaged: it does not fit its checksum")
    entry = parse_json(body, Entry, name)
    if entry.success != (entry.steps > 0):
        raise ValueError(f"{name} is damaged: a success has steps, and a failure has none")
    return entry


def _sealed(body: bytes) -> bytes:
    return b"%s%s%d}" % (body[:-1], CHECK, zlib.crc32(body))


def dumps(value: Any) -> str:
    """JSON on one line, with arrays as lists; a ValueError for what is none of numbers, strings, lists and dicts."""
    return json.dumps(value, default=_plain, allow_nan=False, ensure_ascii=False)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise ValueError(f"an episode store keeps numbers, strings, lists and dicts, not {value!r}")


def listed(numbers: Sequence[int]) -> str:
    """Seeds or lines in words, not too many."""
    ordered = sorted(set(numbers))
    if len(ordered) > 2 and ordered[-1] - ordered[0] == len(ordered) - 1:
        return f"{ordered[0]} to {ordered[-1]}"
    more = f" and {len(ordered) - LISTED} others" if len(ordered) > LISTED else ""
    return ", ".join(map(str, ordered[:LISTED])) + more


def read_index(path: Path, any_seed: bool, damaged: bool) -> tuple[list[Entry], int]:
    """The entries and the number of bytes they take: a last line that was cut short does not count.

    Unless `any_seed`, seeds are consecutive, so that it can be told which are `LOST` in a `damaged` index.

    Raises:
        ValueError: lines are damaged, all of which are named, or do not follow each other.
    """
    lines = _lines(path)
    entries: dict[int, Entry] = {}  # line number → entry
    problems: dict[int, str] = {}
    for number, line in enumerate(lines, start=1):
        try:
            entries[number] = parse_line(line, f"line {number} of {path}")
        except ValueError as error:
            problems[number] = str(error)
    salvaged = damaged and not any_seed and bool(entries)
    remedy = REMEDY if any_seed or not entries else SALVAGE
    if problems and not salvaged:
        first, *others = problems
        more = f"; so are the lines {listed(others)}" if others else ""
        raise ValueError(f"{problems[first]}{more}: {remedy}")
    if salvaged:
        return _with_lost(entries, len(lines)), 0
    rows, seed = 0, None
    for number, entry in entries.items():
        if entry.start != rows or (entry.seed != seed and seed is not None and not any_seed):
            raise ValueError(f"line {number} of {path} does not follow the line before it: {remedy}")
        rows, seed = entry.start + entry.steps, entry.seed + 1
    return [*entries.values()], sum(len(line) + 1 for line in lines)


def _lines(path: Path) -> list[bytes]:
    """Every line that was written completely, without its end."""
    *lines, rest = path.read_bytes().split(b"\n") if path.exists() else [b""]
    # What a process leaves that is killed in a line is shorter: here only the line end was damaged.
    whole = _sealed(rest[:-1].rpartition(CHECK)[0] + b"}") == rest[:-1]
    return [*lines, rest] if whole else lines


def _with_lost(entries: dict[int, Entry], lines: int) -> list[Entry]:
    """The entries of consecutive seeds with a `LOST` one for each that is missing between them, before and after."""
    found: list[Entry] = []
    rows = last = 0
    for number, entry in entries.items():
        before = found[-1].seed if found else entry.seed - number
        if not 1 <= entry.seed - before <= number - last + 1:  # a lost line end makes one line of two
            continue
        found += [_lost(seed, rows) for seed in range(max(before + 1, 0), entry.seed)]
        found.append(entry)
        rows, last = entry.start + entry.steps, number
    return found + [_lost(found[-1].seed + 1 + number, rows) for number in range(lines - last)]


def _lost(seed: int, row: int) -> Entry:
    return Entry(seed, LOST, "", row, 0, {}, {})
