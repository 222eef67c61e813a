"""Episode store: one flat file per field and one index line per tried seed.

A folder holds `store.json` (the layout of the rows), `<field>.bin` (the rows of all episodes, in order) and
`index.jsonl`. An episode exists once its index line does: its rows are written before the line, so a process killed at
any moment leaves at most rows without a line, which the next writer truncates. The bytes depend on the episodes only,
never on time or on the number of processes.

A collected store holds consecutive seeds of one config and can grow. A derived store (`vla.data.verification`) lists
the configs of its sources as `parts`, holds any seeds, and cannot grow. Nor can a store with packed images
(`vla.data.formats.packed`), whose `store.json` gives the codec of every packed field.
"""

from __future__ import annotations

import json
import logging
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from filelock import FileLock, Timeout

from vla.data.header import fields_of, images_of, is_store, read_header, write_header
from vla.data.image_codec import JPEG, PackedRows, whole_rows
from vla.data.index import REMEDY, SALVAGE, Entry, dumps, index_line, listed, parse_line, read_index
from vla.data.scattered_rows import ScatteredRows
from vla.data.statistics import Statistics
from vla.io.documents import canonical
from vla.io.files import require_file
from vla.parallel.limits import memory
from vla.spec import FIRST_SEED, Array, Episode, Observation, Spec

Rows = Array | PackedRows

BLOCK = 256  # rows per update of a checksum
IN_MEMORY = 0.25  # largest share of the memory that a store takes that is expected to stay in it

log = logging.getLogger(__name__)


class EpisodeStore:
    """Episodes on disk, opened for reading; `create_or_open` and `writing` extend it.

    Attributes:
        header: content of `store.json`.
        spec: layout of a step.
        config: of the task and the expert of the episodes.
        fields: field → shape and dtype of a row, see `fields_of`.
        packed: packed field → codec.
        tried: one entry per seed.
        episodes: those of the stored episodes, of seeds that succeeded and of labelled failures; at most `episodes`.

    Args:
        folder: of the store.
        episodes: use only the first so many; all of them when None.
        damaged: also open a store with truncated files or unreadable index lines; the seeds of the latter are `LOST`.

    Raises:
        ValueError: the folder holds no store, or one that has another format, is damaged, or is too short.
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
        """Open the store in `folder`, or create an empty one.

        Raises:
            ValueError: the store has another spec or config, or lacks its `store.json`.
        """
        folder = Path(folder)
        plain = json.loads(dumps(config))
        if not is_store(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / "lock"):
                write_header(folder, spec, plain)
        store = cls(folder)
        spec.require(store.spec, "this task", f"the episode store {folder}")
        store.require(plain)
        return store

    def require(self, config: Mapping[str, Any]) -> None:
        """Raise a ValueError if the episodes have another config.

        A derived store may differ: its episodes were chosen explicitly.
        """
        if self.derived:
            return
        asked, there = canonical(json.loads(dumps(config))), canonical(self.config)
        different = sorted(key for key in {*asked, *there} if asked.get(key) != there.get(key))
        if different:
            raise ValueError(f"{self.folder} was collected with another config for {different}: choose another folder")

    def require_first_seed(self, seed: int) -> None:
        """Raise a ValueError if the first episode has another seed; a derived store may begin anywhere."""
        if self.tried and not self.derived and self.tried[0].seed != seed:
            first = self.tried[0].seed
            raise ValueError(f"{self.folder} starts at seed {first}, not {seed}: set collect.seed={first}")

    def require_growable(self) -> None:
        """Raise a ValueError if no episodes may be added, because the present ones were copied from other stores."""
        if self.derived:
            most = len(self.episodes)
            raise ValueError(
                f"{self.folder} was derived from other stores and cannot grow: set collect.episodes={most}"
            )

    def require_episodes(self) -> None:
        """Raise a ValueError if there are no episodes."""
        if not self.episodes:
            raise ValueError(f"{self.folder} holds no episodes yet: collect some first")

    @property
    def derived(self) -> bool:
        """True if the episodes were copied from other stores rather than collected."""
        return "parts" in self.config

    @property
    def next_seed(self) -> int | None:
        """Next seed to try; None if none has been tried yet, or if any may follow."""
        return self.tried[-1].seed + 1 if self.tried and not self.derived else None

    @property
    def statistics(self) -> Statistics:
        """Bounds and a sample of the actions in `episodes`; a ValueError if there are none, or if they are damaged."""
        self.require_episodes()
        actions = self.rows("action")
        self.verify(self.episodes, {"action": actions})
        ends = np.array([entry.end for entry in self.episodes])
        return Statistics(np.asarray(actions)[: ends[-1]], ends)

    def rows(self, field: str) -> Rows:
        """Return all committed rows of `field`, (N, …), which are read when they are indexed.

        They are a memory-mapped array, or `PackedRows`, which raise a ValueError with the seed of a damaged image.
        """
        if field not in self.fields:
            raise ValueError(f"{self.folder} has no field {field!r}: it has {sorted(self.fields)}")
        shape, dtype = self.fields[field]
        if self._rows == 0:
            return np.empty((0, *shape), dtype)
        if field in self.packed:
            return PackedRows(self.folder, field, self.packed[field], (self._rows, *shape), dtype, self._changed_at)
        return np.asarray(np.memmap(self._path(field), dtype, mode="r", shape=(self._rows, *shape)))

    def scattered(self, field: str) -> Rows | ScatteredRows:
        """Return the same rows to take in random order; if the store is large, only what is taken is read."""
        if field in self.packed or not self._large:
            return self.rows(field)
        shape, dtype = self.fields[field]
        return ScatteredRows(self._path(field), (self._rows, *shape), dtype)

    @property
    def _large(self) -> bool:
        """Whether the rows may not stay in memory."""
        sizes = (prod(shape) * dtype.itemsize for shape, dtype in self.fields.values())
        return self._rows * sum(sizes) > IN_MEMORY * memory()

    def read(self, entry: Entry) -> dict[str, Array]:
        """Read one episode as field → (steps, …) rows; a ValueError if a checksum differs."""
        sources = {field: self.rows(field) for field in self.fields}
        rows = {field: np.array(source[entry.span]) for field, source in sources.items()}
        for field, values in rows.items():
            # JPEG decoders may round differently, so the checksum of a JPEG is that of its file.
            checked = stored(sources[field], entry.span) if self.lossy(field) else values
            if len(values) < entry.steps or zlib.crc32(checked.data) != entry.crc.get(field):
                raise self._changed([entry.seed])
        return rows

    def verify(self, entries: Iterable[Entry], rows: Mapping[str, Rows | ScatteredRows]) -> None:
        """Compare the `rows` of episodes, by field, with their checksums.

        Raises:
            ValueError: some differ; the message names their seeds.
        """
        changed = [
            entry.seed
            for entry in entries
            if not all(self._intact(entry, field, source) for field, source in rows.items())
        ]
        if changed:
            raise self._changed(changed)

    def _intact(self, entry: Entry, field: str, rows: Rows | ScatteredRows) -> bool:
        crc = 0
        try:
            for first in range(entry.start, entry.end, BLOCK):
                span = slice(first, min(first + BLOCK, entry.end))
                crc = zlib.crc32((stored(rows, span) if self.lossy(field) else rows[span]).data, crc)
        except ValueError:  # an image that cannot be decoded
            return False
        return crc == entry.crc.get(field)

    def lossy(self, field: str) -> bool:
        """Return whether the rows of `field` are compressed with loss."""
        return self.packed.get(field) == JPEG

    def _changed(self, seeds: Sequence[int]) -> ValueError:
        which = f"seed {seeds[0]}" if len(seeds) == 1 else f"the seeds {listed(seeds)}"
        return ValueError(f"the rows of {which} in {self.folder} were changed on disk: {SALVAGE}")

    def _changed_at(self, row: int) -> ValueError:
        return self._changed([entry.seed for entry in self.episodes if row < entry.end][:1])

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Lock the store for writing, after any other writer, and truncate what a killed one left incomplete."""
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
            paths = {name: self._path(name) for name in ("index", *self.fields)}
            _require_own_files(paths.values())
            for name, path in paths.items():
                self._files[name] = stack.enter_context(path.open("ab", buffering=0))
            stack.callback(self._files.clear)
            self._cut()
            yield
            # Once, because it costs more than collecting an episode. A power cut before this point may damage the
            # newest episodes, which their checksums detect; a killed process loses nothing, the kernel has its writes.
            for file in self._files.values():
                os.fsync(file.fileno())

    def append(self, episode: Episode) -> None:
        """Store an episode atomically: a success, or a failure whose labels are to be kept.

        Raises:
            ValueError: it does not match the spec, has several instructions or another seed than the next, or cannot be
                written.
        """
        if len({seen.instruction for seen in episode.observations}) > 1:
            raise ValueError(
                f"seed {episode.seed} has several instructions, and a store keeps one per episode: give episodes below "
                f"seed {FIRST_SEED} one each"
            )
        try:
            rows = self._rows_of(episode)
        except KeyError as error:
            raise ValueError(f"seed {episode.seed}: an observation lacks {error}, which the spec names") from error
        self._commit(self._entry(episode, episode.instruction, len(episode.actions), checksums(rows)), rows)

    def fail(self, episode: Episode) -> None:
        """Store the outcome of a failed seed, without rows. Raises as `append` does."""
        self._commit(self._entry(episode, "", 0, {}), {})

    def _entry(self, episode: Episode, instruction: str, steps: int, crc: dict[str, int]) -> Entry:
        milestones = tuple(sorted(episode.milestones))
        what = (episode.seed, episode.task, episode.outcome, milestones, instruction)
        return Entry(*what, self._rows, steps, dict(episode.draws), crc)

    def _commit(self, entry: Entry, rows: Mapping[str, Array]) -> None:
        assert self._files, "append and fail work inside `with store.writing()`"
        if self.next_seed not in (None, entry.seed):
            raise ValueError(f"{self.folder} expects seed {self.next_seed} next, got seed {entry.seed}")
        line = index_line(entry)
        entry = parse_line(line[:-1], f"{self.folder}: the entry of seed {entry.seed}")  # validated as a reader does
        try:
            for name, values in rows.items():
                _write(self._files[name], values.data.cast("B"))
            _write(self._files["index"], memoryview(line))
            self.tried.append(entry)
            if entry.stored and (self._limit is None or len(self.episodes) < self._limit):
                self.episodes.append(entry)
            self._rows += entry.steps
            self._index_size += len(line)
        except OSError as error:
            safe = f"the {len(self.episodes)} episodes before it are safe, make room and run again to continue"
            raise ValueError(f"{self.folder} cannot take seed {entry.seed} ({error.strerror}): {safe}") from error
        finally:
            self._cut()

    def _cut(self) -> None:
        # The index first: no line may refer to truncated rows at any moment.
        self._files["index"].truncate(self._index_size)
        for field in self.fields:
            self._files[field].truncate(self._size(field))

    def _refresh(self) -> None:
        index = self._path("index")
        if not index.exists() and (there := [field for field in self.fields if self._path(field).exists()]):
            raise ValueError(f"{index} is missing, which {self._path(there[0]).name} beside it needs: {REMEDY}")
        self.tried, self._index_size = read_index(self._path("index"), self.derived, self._damaged)
        self.episodes = [entry for entry in self.tried if entry.stored][: self._limit]
        self._rows = max((entry.end for entry in self.tried), default=0)
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
        observations = episode.observations
        columns: dict[str, Any] = {"action": episode.actions, "executed": episode.executed}
        columns["state"] = [observation.state for observation in observations]
        for name in images_of(self.spec):
            kind, _, camera = name.partition("_")
            columns[name] = [getattr(observation, kind)[camera] for observation in observations]
        if self.spec.truth:
            columns["truth"] = [
                np.hstack([np.ravel((one.truth or {})[key]) for key, _ in self.spec.truth]) for one in observations
            ]
        return {name: self._column(name, columns[name], len(observations)) for name in self.fields}

    def _column(self, name: str, values: Any, steps: int) -> Array:
        shape, dtype = self.fields[name]
        column = np.asarray(values)
        if column.shape != (steps, *shape) or not np.can_cast(column.dtype, dtype, "same_kind"):
            raise ValueError(f"{name} must be {(steps, *shape)} {dtype}, got {column.shape} {column.dtype}")
        return np.ascontiguousarray(column, dtype)

    def _size(self, field: str) -> int:
        shape, dtype = self.fields[field]
        return self._rows * int(np.prod(shape)) * dtype.itemsize

    def _path(self, name: str) -> Path:
        if name in self.packed:
            return self.folder / f"{name}.pack"
        return self.folder / ("index.jsonl" if name == "index" else f"{name}.bin")


def observations_of(spec: Spec, rows: Mapping[str, Array], instruction: str) -> list[Observation]:
    """Return the observations of an episode from its rows, field → (steps, …)."""
    names, ends = [name for name, _ in spec.truth], np.cumsum([size for _, size in spec.truth])
    return [
        Observation(
            rgb={camera: rows[f"rgb_{camera}"][step] for camera in spec.cameras},
            state=rows["state"][step],
            instruction=instruction,
            depth={camera: rows[f"depth_{camera}"][step] for camera in spec.depth},
            truth=dict(zip(names, np.split(rows["truth"][step], ends[:-1]), strict=True)) if names else None,
        )
        for step in range(len(rows["state"]))
    ]


def stored(rows: Rows | ScatteredRows, span: slice) -> Array:
    """Return consecutive rows as stored on disk: the rows, or compressed bytes (M,)."""
    return rows.stored(span) if isinstance(rows, PackedRows) else rows[span]


def checksums(rows: Mapping[str, Array]) -> dict[str, int]:
    """Compute field → CRC-32 of rows."""
    return {field: zlib.crc32(values.data) for field, values in rows.items()}


def _require_own_files(paths: Iterable[Path]) -> None:
    """Refuse links, which an archive keeps: what is behind them would be overwritten. Raises a ValueError."""
    for path in paths:
        require_file(path)
        if path.is_symlink():
            raise ValueError(f"{path} is a link, and nothing is added behind a link: copy the file to this place")


def _write(file: BinaryIO, data: memoryview) -> None:
    while data:  # an unbuffered write may be partial
        data = data[file.write(data) :]
