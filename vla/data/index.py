"""Index of an episode store: one line of JSON per tried seed, with a checksum of the line at its end."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, MaxLen, Predicate

from vla.io.documents import STRICT, parse_json, read_bounded
from vla.io.errors import UserError, counted
from vla.io.types import Seed
from vla.spec import LONGEST_INSTRUCTION, Episode, Name

INDEX = "index.jsonl"  # in the folder of a store
REMEDY = "copy the folder again from where it is whole, or delete it and collect again"
SALVAGE = f"keep what is whole with job=inspect inspect.folder=DIR inspect.repair=true, {REMEDY}"
DAMAGED = "damaged"  # outcome of a seed whose episode a repair could not save
LOST = "lost"  # outcome of a seed whose index line is unreadable
NOT_NEEDED = "not_needed"  # outcome of a seed that was skipped, because its task had its share of episodes
CHECK = b', "check": '  # precedes the CRC-32 of the line without it, at the end of every line
MAX_INDEX_BYTES = 4 << 30  # millions of seeds
MAX_LISTED = 8  # largest number of numbers in a message


def moderate(value: Any) -> bool:
    """with numbers within 2^63 only, so neither NaN nor infinity"""
    if isinstance(value, (dict, list)):
        return all(map(moderate, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, (int, float)) or abs(value) <= 2**63


JsonObject = Annotated[dict[str, Any], Predicate(moderate)]  # from JSON
Offset = Annotated[int, Ge(0), Le(2**53)]
Crc = Annotated[int, Ge(0), Le(2**32 - 1)]


@dataclass(frozen=True)
class Entry:
    """Index line of a tried seed; its episode is stored if it has steps, which a success always has."""

    __pydantic_config__ = STRICT

    seed: Seed
    task: Annotated[str, MaxLen(100)]  # empty if unknown
    outcome: Name  # "success" or the name of the failure
    milestones: tuple[Name, ...]  # in alphabetical order
    instruction: Annotated[str, MaxLen(LONGEST_INSTRUCTION)]
    start: Offset  # first row of the episode in every field file
    steps: Offset
    draws: JsonObject  # randomisation axis → drawn values
    crc: dict[str, Crc]  # field → CRC-32 of its rows, or of the files if they are JPEG; empty for failures

    @property
    def success(self) -> bool:
        """True if the goal was reached and held."""
        return self.outcome == "success"

    @property
    def is_stored(self) -> bool:
        """True if the episode is stored: every success, and the failures of a policy that an expert labels."""
        return self.steps > 0

    @property
    def end(self) -> int:
        """The row after the last of the episode."""
        return self.start + self.steps

    @property
    def span(self) -> slice:
        """The rows of the episode in every field file."""
        return slice(self.start, self.end)


def recording_of(episode: Entry | Episode) -> int:
    """Return the number of the recorded episode that an episode is, or is a part of; its seed if it was not recorded.

    Parts of one recording show the same scene: they are held out together, and count as one in statistics.
    """
    recorded = episode.draws.get("recorded")
    number = recorded.get("episode") if isinstance(recorded, dict) else None
    return number if isinstance(number, int) else episode.seed


def index_line(entry: Entry) -> bytes:
    """Encode an entry as a line of the index."""
    return _seal(dumps(asdict(entry)).encode()) + b"\n"


def parse_line(line: bytes, name: str) -> Entry:
    """Decode a line without its line end (UserError: the line is damaged; the message begins with `name`)."""
    body = line.rpartition(CHECK)[0] + b"}"
    if _seal(body) != line:
        raise UserError(f"{name} is damaged: it does not fit its checksum")
    entry = parse_json(body, Entry, name)
    if entry.success and not entry.is_stored:
        raise UserError(f"{name} is damaged: it is a success without steps")
    return entry


def _seal(body: bytes) -> bytes:
    return b"%s%s%d}" % (body[:-1], CHECK, zlib.crc32(body))


def dumps(value: Any) -> str:
    """Encode as JSON on one line, with arrays as lists; a UserError for other types and numbers than JSON has."""
    try:
        return json.dumps(value, default=_to_plain, allow_nan=False, ensure_ascii=False)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"an episode store keeps finite numbers: {error}") from error


def _to_plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise UserError(f"an episode store keeps numbers, strings, lists and dicts, not {value!r}")


def format_numbers(numbers: Sequence[int]) -> str:
    """Format seeds or line numbers for a message, abbreviated if they are many."""
    ordered = sorted(set(numbers))
    if len(ordered) > 2 and ordered[-1] - ordered[0] == len(ordered) - 1:
        return f"{ordered[0]} to {ordered[-1]}"
    suffix = f" and {counted(len(ordered) - MAX_LISTED, 'other')}" if len(ordered) > MAX_LISTED else ""
    return ", ".join(map(str, ordered[:MAX_LISTED])) + suffix


def read_index(path: Path, any_seed: bool, allow_damage: bool) -> tuple[list[Entry], int]:
    """Return the entries and their size in bytes, without an incomplete last line (UserError: lines are damaged, and
    named in the message, or do not follow each other).

    Unless `any_seed`, seeds are consecutive, which identifies the `LOST` ones if damage is allowed.
    """
    lines = _lines(path)
    entries: dict[int, Entry] = {}  # line number → entry
    problems: dict[int, str] = {}
    for number, line in enumerate(lines, start=1):
        try:
            entries[number] = parse_line(line, f"line {number} of {path}")
        except UserError as error:
            problems[number] = str(error)
    remedy = REMEDY if any_seed or not entries else SALVAGE
    if allow_damage and remedy == SALVAGE:
        return _with_lost_entries(path, entries, len(lines)), 0
    if problems:
        first_line, *other_lines = problems
        suffix = f"; so are the lines {format_numbers(other_lines)}" if other_lines else ""
        raise UserError(f"{problems[first_line]}{suffix}: {remedy}")
    rows, seed = 0, None
    for number, entry in entries.items():
        if entry.start != rows or (entry.seed != seed and seed is not None and not any_seed):
            raise UserError(f"line {number} of {path} does not follow the line before it: {remedy}")
        rows, seed = entry.end, entry.seed + 1
    return [*entries.values()], sum(len(line) + 1 for line in lines)


def _lines(path: Path) -> list[bytes]:
    """Return every complete line, without its line end."""
    *lines, rest = read_bounded(path, MAX_INDEX_BYTES).split(b"\n") if path.exists() else [b""]
    # A process killed within a line leaves a shorter one: here only the line end is damaged.
    is_complete = _seal(rest[:-1].rpartition(CHECK)[0] + b"}") == rest[:-1]
    return [*lines, rest] if is_complete else lines


def _with_lost_entries(path: Path, entries: dict[int, Entry], lines: int) -> list[Entry]:
    """Return the readable entries with a `LOST` one for every seed between, before and after them that has none."""
    first_line, last_line = min(entries), max(entries)  # numbers of lines
    oldest, newest = entries[first_line], entries[last_line]
    cut_off = int(first_line == 1 and oldest.start > 0)  # lines at the start: the first rows belong to a lost entry
    seeds = range(max(oldest.seed - first_line + 1 - cut_off, 0), newest.seed + lines - last_line + 1)
    if len(seeds) > 2 * lines:  # a damaged line end joins two lines, so there are at most two seeds to a line
        raise UserError(f"{path} has too few lines for its seeds, {oldest.seed} to {newest.seed}: {REMEDY}")
    entry_by_seed = {entry.seed: entry for entry in entries.values()}
    all_entries, row = list[Entry](), 0
    for seed in seeds:
        all_entries.append(entry_by_seed.get(seed, Entry(seed, "", LOST, (), "", row, 0, {}, {})))
        row = all_entries[-1].end
    return all_entries
