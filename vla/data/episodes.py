"""The episode store: one flat file per field, one index line per tried seed, and nothing else.

A folder holds `store.json` (what the rows mean), `<field>.bin` (the rows of every episode, one after the other) and
`index.jsonl`. An episode exists once its index line does: its rows are flushed to disk before the line is, so a
process killed at any moment leaves at most a tail that no line speaks of, and the next writer cuts it off. The bytes
depend on the episodes only, never on when or by how many processes they were made.

A store that was collected holds consecutive seeds of one config, and grows. One that was put together from others
(`vla.data.inspection`) has their configs as `parts` in its own, holds whatever seeds were chosen, and does not grow.
Nor does one with packed images (`vla.data.packed`), in which `store.json` says which field is packed how.
"""

from __future__ import annotations

import json
import logging
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from filelock import FileLock, Timeout

from vla.data.header import fields_of, header_of, read_header, write_header
from vla.data.index import SALVAGE, Entry, dumps, index_line, listed, parse_line, read_index
from vla.data.pack import JPEG, PackedRows, whole_rows
from vla.data.statistics import Statistics, statistics_of
from vla.spec import Array, Episode, Spec

Rows = Array | PackedRows

BLOCK = 256  # rows whose checksum is computed at once

log = logging.getLogger(__name__)


class EpisodeStore:
    """Episodes on disk, opened for reading; `create_or_open` and `writing` make it grow.

    Attributes: `header`, all that `store.json` says; `spec`; `config`, what made the episodes; `fields`, as
    `fields_of`; `packed`, field of packed images → codec; `tried`, one entry per seed. With `episodes` only the first
    so many are seen. With `damaged` a store whose files are cut short or whose index has unreadable lines is opened as
    well, to read what is left; the seeds of such lines are `LOST`. Raises a ValueError where there is no store, its
    format is unknown, it is damaged, or it holds fewer than `episodes`.
    """

    def __init__(self, folder: str | Path, episodes: int | None = None, damaged: bool = False) -> None:
        self.folder = Path(folder)
        self.header, self.spec = read_header(self.folder)
        self.config: dict[str, Any] = self.header.config
        self.fields = fields_of(self.spec)
        self.packed: Mapping[str, str] = self.header.packed
        self._limit, self._damaged = episodes, damaged
        self._files: dict[str, BinaryIO] = {}
        self._refresh()
        if episodes is not None and len(self.episodes) < episodes:
            raise ValueError(f"{folder} holds {len(self.episodes)} of {episodes} episodes: collect the rest first")

    @classmethod
    def create_or_open(cls, folder: str | Path, spec: Spec, config: Mapping[str, Any]) -> EpisodeStore:
        """The store in `folder`, made there if there is none; a ValueError if it has another spec or config.

        Another is for episodes that lie there without the `store.json` that would say what they are.
        """
        folder = Path(folder)
        plain = json.loads(dumps(config))
        if not (folder / "store.json").exists():
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / "lock"):
                write_header(folder, header_of(spec, plain))
        store = cls(folder)
        spec.require(store.spec, "this task", f"the episode store {folder}")
        different = sorted(key for key in {*plain, *store.config} if plain.get(key) != store.config.get(key))
        if different and not store.derived:  # which was put together by somebody who knows why
            raise ValueError(f"{folder} was collected with another config for {different}: choose another folder")
        return store

    @property
    def episodes(self) -> list[Entry]:
        """The entries of the stored episodes: the tried seeds that succeeded."""
        return [entry for entry in self.tried if entry.success][: self._limit]

    @property
    def derived(self) -> bool:
        """Whether the episodes were chosen from other stores, rather than collected."""
        return "parts" in self.config

    @property
    def next_seed(self) -> int | None:
        """The seed to try next; None while none has been tried, or where any may follow."""
        return self.tried[-1].seed + 1 if self.tried and not self.derived else None

    @property
    def statistics(self) -> Statistics:
        """Moments of the actions in `episodes`, and a sample of them; a ValueError if there are none, or damaged."""
        if not self.episodes:
            raise ValueError(f"{self.folder} holds no episodes yet: collect some first")
        actions = self.rows("action")
        self.verify(self.episodes, {"action": actions})
        return statistics_of(self.episodes, np.asarray(actions))

    def rows(self, field: str) -> Rows:
        """All committed rows of `field`, (N, …): nothing is read until it is indexed.

        An array, memory-mapped, or `PackedRows`, which raise a ValueError that names the seed of what is damaged.
        """
        if field not in self.fields:
            raise ValueError(f"{self.folder} has no field {field!r}: it has {sorted(self.fields)}")
        shape, dtype = self.fields[field]
        if self._rows == 0:
            return np.empty((0, *shape), dtype)
        if field in self.packed:
            return PackedRows(self.folder, field, self.packed[field], (self._rows, *shape), dtype, self._changed_at)
        return np.asarray(np.memmap(self._path(field), dtype, mode="r", shape=(self._rows, *shape)))

    def read(self, entry: Entry) -> dict[str, Array]:
        """Field → (steps, …) rows of one episode; a ValueError if they are not those that were written."""
        span = slice(entry.start, entry.start + entry.steps)
        sources = {field: self.rows(field) for field in self.fields}
        rows = {field: np.array(source[span]) for field, source in sources.items()}
        for field, values in rows.items():
            # Decoders may differ in how they round, so what is checked of a JPEG is the file.
            checked = stored(sources[field], span) if self.lossy(field) else values
            if len(values) < entry.steps or zlib.crc32(checked.data) != entry.crc.get(field):
                raise self._changed([entry.seed])
        return rows

    def verify(self, entries: Iterable[Entry], rows: Mapping[str, Rows]) -> None:
        """Compare the rows of episodes, field → what `rows` gives, with their checksums.

        Raises:
            ValueError: some are not those that were written; names the seeds.
        """
        changed = [
            entry.seed
            for entry in entries
            if not all(self._intact(entry, field, source) for field, source in rows.items())
        ]
        if changed:
            raise self._changed(changed)

    def _intact(self, entry: Entry, field: str, rows: Rows) -> bool:
        crc, end = 0, entry.start + entry.steps
        try:
            for first in range(entry.start, end, BLOCK):
                span = slice(first, min(first + BLOCK, end))
                crc = zlib.crc32((stored(rows, span) if self.lossy(field) else rows[span]).data, crc)
        except ValueError:  # an image that cannot be decoded
            return False
        return crc == entry.crc.get(field)

    def lossy(self, field: str) -> bool:
        """Whether the rows of `field` are only like those that were recorded."""
        return self.packed.get(field) == JPEG

    def _changed(self, seeds: Sequence[int]) -> ValueError:
        which = f"seed {seeds[0]}" if len(seeds) == 1 else f"the seeds {listed(seeds)}"
        return ValueError(f"the rows of {which} in {self.folder} were changed on disk: {SALVAGE}")

    def _changed_at(self, row: int) -> ValueError:
        return self._changed([entry.seed for entry in self.episodes if row < entry.start + entry.steps][:1])

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the store for writing: waits for another writer, then cuts off what a killed one left unfinished."""
        assert not self._damaged, "a damaged store is left as it is"
        if self.packed:
            raise ValueError(
                f"{self.folder} is packed and does not grow: set collect.episodes={len(self.episodes)}, or collect "
                "into another folder and pack that"
            )
        lock = FileLock(self.folder / "lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("waiting for the process that is collecting into %s", self.folder)
            lock.acquire()
        with ExitStack() as stack:
            stack.callback(lock.release)
            self._refresh()
            for name in ("index", *self.fields):
                self._files[name] = stack.enter_context(self._path(name).open("ab", buffering=0))
            stack.callback(self._files.clear)
            self._cut()
            yield
            # Once, not per episode, which would cost more than making it. A power cut before this point may garble the
            # newest episodes, which their checksums tell; a killed process loses nothing, the system has its writes.
            for file in self._files.values():
                os.fsync(file.fileno())

    def append(self, episode: Episode) -> None:
        """Store a successful episode: all of it or, whatever happens on the way, nothing.

        A ValueError says that it does not fit the spec, is not the next, or that the disk does not take it.
        """
        assert episode.success, "failures go to `fail`"
        rows = self._rows_of(episode)
        what = (episode.seed, episode.outcome, episode.instruction, self._rows, len(episode.actions))
        self._commit(Entry(*what, dict(episode.draws), checksums(rows)), rows)

    def fail(self, seed: int, outcome: str, draws: Mapping[str, Any]) -> None:
        """Note that `seed` was tried and why it failed; no rows are stored. Raises as `append` does."""
        self._commit(Entry(seed, outcome, "", self._rows, 0, dict(draws), {}), {})

    def _commit(self, entry: Entry, rows: Mapping[str, Array]) -> None:
        assert self._files, "append and fail work inside `with store.writing()`"
        if self.next_seed not in (None, entry.seed):
            raise ValueError(f"{self.folder} expects seed {self.next_seed} next, seed {entry.seed} came")
        line = index_line(entry)
        entry = parse_line(line[:-1], f"{self.folder}: the entry of seed {entry.seed}")  # as a reader will see it
        try:
            for name, values in rows.items():
                _write(self._files[name], values.data.cast("B"))
            _write(self._files["index"], memoryview(line))
            self.tried.append(entry)
            self._rows += entry.steps
            self._index_size += len(line)
        except OSError as error:
            safe = f"the {len(self.episodes)} episodes before it are safe, make room and run again to go on"
            raise ValueError(f"{self.folder} cannot take seed {entry.seed} ({error.strerror}): {safe}") from error
        finally:
            self._cut()

    def _cut(self) -> None:
        # The index first: at no moment may a line speak of rows that are gone.
        os.truncate(self._path("index"), self._index_size)
        for field in self.fields:
            os.truncate(self._path(field), self._size(field))

    def _refresh(self) -> None:
        self.tried, self._index_size = read_index(self._path("index"), self.derived, self._damaged)
        self._rows = max((entry.start + entry.steps for entry in self.tried), default=0)
        for field in self.fields if self._rows else ():
            whole = self._whole(field)
            if whole < self._rows and not self._damaged:
                raise ValueError(f"{self._path(field)} is shorter than its index says: {SALVAGE}")
            self._rows = min(self._rows, whole)

    def _whole(self, field: str) -> int:
        if field in self.packed:
            return whole_rows(self.folder, field, self._rows)
        path, needed = self._path(field), self._size(field)
        size = path.stat().st_size if path.exists() else 0
        return self._rows if size >= needed else self._rows * size // needed

    def _rows_of(self, episode: Episode) -> dict[str, Array]:
        seen = episode.observations
        columns: dict[str, Any] = {"action": episode.actions, "executed": episode.executed}
        columns["gripper"] = [[observation.gripper] for observation in seen]
        for camera in self.spec.cameras:
            columns[f"rgb_{camera}"] = [observation.rgb[camera] for observation in seen]
            columns[f"depth_{camera}"] = [observation.depth[camera] for observation in seen]
        for name in ("joints", "velocities"):
            columns[name] = [getattr(observation, name) for observation in seen]
        if self.spec.truth:
            columns["truth"] = [
                np.hstack([np.ravel((one.truth or {})[key]) for key, _ in self.spec.truth]) for one in seen
            ]
        return {name: self._column(name, columns[name], len(seen)) for name in self.fields}

    def _column(self, name: str, values: Any, steps: int) -> Array:
        shape, dtype = self.fields[name]
        column = np.asarray(values)
        if column.shape != (steps, *shape) or not np.can_cast(column.dtype, dtype, "same_kind"):
            raise ValueError(f"{name} must be {(steps, *shape)} {dtype}, it came as {column.shape} {column.dtype}")
        return np.ascontiguousarray(column, dtype)

    def _size(self, field: str) -> int:
        shape, dtype = self.fields[field]
        return self._rows * int(np.prod(shape)) * dtype.itemsize

    def _path(self, name: str) -> Path:
        if name in self.packed:
            return self.folder / f"{name}.pack"
        return self.folder / ("index.jsonl" if name == "index" else f"{name}.bin")


def stored(rows: Rows, span: slice) -> Array:
    """Consecutive rows as they lie on the disk: themselves, or bytes (M,)."""
    return rows[span] if isinstance(rows, np.ndarray) else rows.stored(span)


def checksums(rows: Mapping[str, Array]) -> dict[str, int]:
    """What an entry keeps of the rows of its episode: field → CRC-32."""
    return {field: zlib.crc32(values.data) for field, values in rows.items()}


def _write(file: BinaryIO, data: memoryview) -> None:
    while data:  # an unbuffered write may take only a part
        data = data[file.write(data) :]
