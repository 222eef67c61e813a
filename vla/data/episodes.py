"""Episode store: one flat file per field and one index line per tried seed.

A folder holds `store.json` (the layout of the rows), the files of every field (the rows of all episodes, in order, see
`vla.data.fields`) and `index.jsonl`. An episode exists once its index line does: its rows are written before the line,
so a process killed at any moment leaves at most rows without a line, which the next writer truncates. The bytes depend
on the episodes only, never on time or on the number of processes.

A collected store holds consecutive seeds of one config and can grow. A derived store (`vla.data.derivation`) lists
the configs of its sources as `parts`, holds any seeds, and cannot grow.

Images are raw or compressed one by one. A codec without loss changes neither config nor checksums of the episodes.
"""

from __future__ import annotations

import json
import logging
import os
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from filelock import FileLock, Timeout

from vla.data.fields import Field, Rows, ScatteredRows
from vla.data.header import RAW, Codec, fields_of, is_store, read_header, write_header
from vla.data.index import INDEX, REMEDY, SALVAGE, Entry, dumps, format_numbers, index_line, parse_line, read_index
from vla.io.documents import canonicalize
from vla.io.errors import UserError, counted
from vla.parallel.limits import memory
from vla.spec import FIRST_SEED, ActionStatistics, Array, Episode, Observation, Spec

IN_MEMORY = 0.25  # a store is expected to stay in memory if it takes at most this share of it

log = logging.getLogger(__name__)


class DamageError(UserError):
    """Rows of a store are damaged; `damage` is the kind of damage."""

    def __init__(self, message: str, damage: str = "rows changed or lost") -> None:
        super().__init__(f"{message}: {SALVAGE}")
        self.damage = damage


class EpisodeStore:
    """Episodes on disk, opened for reading; `create_or_open` and `writing` extend it (UserError: the folder holds no
    store, or one that has another format, is damaged, or has too few episodes).

    Attributes:
        spec: layout of a step.
        config: of the task and the expert of the episodes.
        fields: field → its files, see `fields_of`.
        row_size: size of a decoded row in all fields together [bytes].
        codec: of the images.
        attempts: one entry per seed.
        episodes: entries of the stored episodes, successes and labelled failures; at most `episodes`.

    Args:
        folder: of the store.
        episodes: number of episodes to use, the first ones; None: all.
        allow_damage: also open a store with truncated files or unreadable index lines; the seeds of the latter
            are `LOST`.
    """

    def __init__(self, folder: str | Path, episodes: int | None = None, allow_damage: bool = False) -> None:
        self.folder = Path(folder)
        header, self.spec = read_header(self.folder)
        self.config: dict[str, Any] = header.config
        self.codec: Codec = header.codec
        self.fields = {name: Field(self.folder, name, *row, self.codec) for name, row in fields_of(self.spec).items()}
        self.row_size = sum(column.size for column in self.fields.values())
        self._limit, self._damaged = episodes, allow_damage
        self._index, self._files = self.folder / INDEX, dict[Path, BinaryIO]()
        self._refresh()
        if episodes is not None and len(self.episodes) < episodes:
            raise UserError(f"{folder} holds {len(self.episodes)} of {episodes} episodes: collect the rest first")

    @classmethod
    def create_or_open(
        cls, folder: str | Path, spec: Spec, config: Mapping[str, Any], codec: Codec | None = None
    ) -> EpisodeStore:
        """Open the store in `folder`, or create an empty one, whose codec by default suits its image size (UserError:
        the store has another spec or config, other losses than `codec`, or lacks its `store.json`)."""
        folder, plain_config = Path(folder), json.loads(dumps(config))
        if not is_store(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / "lock"):
                write_header(folder, spec, plain_config, codec or Codec.for_spec(spec))
        store = cls(folder)
        spec.require(store.spec, "this task", f"the episode store {folder}")
        store.require(plain_config, codec)
        return store

    def require(self, config: Mapping[str, Any], codec: Codec | None) -> None:
        """Raise a UserError if the episodes have another config, except in a derived store, which is chosen explicitly,
        or the images other losses than those of `codec`; None accepts any."""
        new_config, stored_config = canonicalize(json.loads(dumps(config))), canonicalize(self.config)
        keys = sorted(key for key in {*new_config, *stored_config} if new_config.get(key) != stored_config.get(key))
        if keys and not self.is_derived:
            raise UserError(f"{self.folder} has episodes of another {', '.join(keys)}: set another collect.folder")
        if codec is not None and codec.loss != self.codec.loss:
            raise UserError(
                f"{self.folder} holds {self.codec}, not {codec}: set another collect.folder, or omit collect.images"
            )

    def lacks(self, key: str, node: Any) -> bool:
        """Return whether the store is derived, and no part of it has `node` under `key` in its config."""
        plain_node = canonicalize(json.loads(dumps(node)))
        return self.is_derived and all(
            canonicalize(config.get(key)) != plain_node for config, _ in self.config["parts"]
        )

    def require_first_seed(self, seed: int) -> None:
        """Raise a UserError if the first episode has another seed; a derived store may begin anywhere."""
        if self.attempts and not self.is_derived and self.attempts[0].seed != seed:
            first_seed = self.attempts[0].seed
            raise UserError(f"{self.folder} starts at seed {first_seed}, not {seed}: set collect.seed={first_seed}")

    def require_growable(self) -> None:
        """Raise a UserError if no episodes may be added, because the present ones were copied from other stores."""
        if self.is_derived:
            size = len(self.episodes)
            raise UserError(f"{self.folder} was derived from other stores and cannot grow: set collect.episodes={size}")

    def require_episodes(self) -> None:
        """Raise a UserError if there are no episodes."""
        if not self.episodes:
            raise UserError(f"{self.folder} holds no episodes yet: collect some first")

    @property
    def is_derived(self) -> bool:
        """True if the episodes were copied from other stores rather than collected."""
        return "parts" in self.config

    @property
    def next_seed(self) -> int | None:
        """Next seed to try; None if none has been tried yet, or if any may follow."""
        return self.attempts[-1].seed + 1 if self.attempts and not self.is_derived else None

    @property
    def statistics(self) -> ActionStatistics:
        """Bounds and a sample of the actions in `episodes`; a UserError if there are none, or if they are damaged."""
        self.require_episodes()
        self.verify(self.episodes, {"action": self.rows("action")})
        return ActionStatistics(self.numbers("action"), np.array([entry.end for entry in self.episodes]))

    def numbers(self, field: str) -> Array:
        """Return the rows of a numeric field in `episodes`, (N, …), without those of further episodes in the store."""
        return np.asarray(self.rows(field))[: self.episodes[-1].end]

    def rows(self, field: str, in_random_order: bool = False) -> Rows:
        """Return all committed rows of `field`, (N, …), which are read when they are indexed.

        Compressed images, and rows of a large store that will be read `in_random_order`, are `ScatteredRows`, which
        raise a DamageError for a damaged image. All other rows are a memory-mapped array. Raises a UserError if there
        is no such field.
        """
        if field not in self.fields:
            raise UserError(f"{self.folder} has no field {field!r}: it has {', '.join(sorted(self.fields))}")
        column = self.fields[field]
        if self._rows == 0:  # an empty file cannot be mapped
            return np.empty((0, *column.shape), column.dtype)
        large = self._rows * self.row_size > IN_MEMORY * memory()
        return column.rows(self._rows, partial(self._image_error, field), in_random_order and large)

    def packed_images(self, entry: Entry) -> dict[str, list[bytes]]:
        """Return the compressed images of an episode, by field; a DamageError if one is damaged."""
        sources = {field: self.rows(field) for field in self.fields}
        return {
            field: rows.packed_rows(entry.span) for field, rows in sources.items() if isinstance(rows, ScatteredRows)
        }

    def size(self, field: str, entry: Entry) -> int:
        """Return the size of a field of an episode on disk [bytes]."""
        starts, ends = (self.fields[field].sizes(rows) for rows in (entry.start, entry.end))
        return sum(ends) - sum(starts)

    def read(self, entry: Entry, fields: Collection[str] | None = None) -> dict[str, Array]:
        """Read one episode as field → (steps, …) rows, by default of all `fields`; a DamageError if a checksum differs.

        A UserError if it is larger than the memory: a few compressed bytes can promise any image.
        """
        size = entry.steps * self.row_size
        if self.codec != RAW and size > (limit := memory()):
            raise UserError(
                f"seed {entry.seed} in {self.folder} unpacks to {size / 1e9:.0f} GB, and this machine has "
                f"{limit / 1e9:.0f} GB of memory: leave it out, or read it on a larger machine"
            )
        sources = {field: self.rows(field) for field in fields or self.fields}
        rows = {field: np.array(source[entry.span]) for field, source in sources.items()}
        for field, values in rows.items():
            if len(values) < entry.steps or _checksum(sources[field], entry.span, values) != entry.crc.get(field):
                raise self._rows_error(entry.seed)
        return rows

    def verify(self, entries: Iterable[Entry], rows: Mapping[str, Rows]) -> None:
        """Compare the `rows` of episodes, by field, with their checksums; a DamageError names the seeds that differ."""
        damages = dict[int, DamageError]()
        for entry in entries:
            try:
                if any(_checksum(source, entry.span) != entry.crc.get(field) for field, source in rows.items()):
                    raise self._rows_error(entry.seed)
            except DamageError as damage:  # also of a compressed image, which is named by its step
                damages[entry.seed] = damage
        if damages:
            raise self._rows_error(*damages) if len(damages) > 1 else damages.popitem()[1]

    def _rows_error(self, *seeds: int) -> DamageError:
        seeds_text = f"seed {seeds[0]}" if len(seeds) == 1 else f"the seeds {format_numbers(seeds)}"
        return DamageError(f"the rows of {seeds_text} in {self.folder} were changed on disk")

    def _image_error(self, field: str, row: int) -> DamageError:
        entry = next(entry for entry in self.attempts if entry.start <= row < entry.end)
        image = f"{field} of step {row - entry.start}"
        message = f"{image} of seed {entry.seed} in {self.folder} was changed on disk"
        return DamageError(message, f"{image} changed or lost")

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Lock the store for writing, waiting for any other writer, and truncate what a killed one left incomplete."""
        assert not self._damaged, "a damaged store is left as it is"
        lock = FileLock(self.folder / "lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("waiting for the process that is collecting into %s", self.folder)
            lock.acquire()
        with ExitStack() as stack:
            stack.callback(lock.release)
            self._refresh()
            paths = (self._index, *(path for column in self.fields.values() for path in column.files))
            for path in paths:  # an unpacked archive may contain links, whose targets would be overwritten
                if path.is_symlink():
                    raise UserError(f"{path} is a link, and a store never writes through one: replace it by a copy")
                self._files[path] = stack.enter_context(path.open("ab", buffering=0))
            stack.callback(self._files.clear)
            self._cut()
            yield
            # Once, because it costs more than collecting an episode. A power cut before this point may damage the
            # newest episodes, which their checksums detect; a killed process loses nothing, the kernel has its writes.
            for file in self._files.values():
                os.fsync(file.fileno())

    def append(self, episode: Episode, packed_images: Mapping[str, Sequence[bytes]] | None = None) -> None:
        """Store an episode atomically: a success, or a failure whose labels are to be kept (UserError: it does not
        match the spec, has several instructions or another seed than the next, or cannot be written).

        `packed_images` are its compressed images from another store with the same codec, so that JPEG loses no more.
        """
        if len({observation.instruction for observation in episode.observations}) > 1:
            raise UserError(
                f"seed {episode.seed} has several instructions, and a store keeps one per episode: give episodes below "
                f"seed {FIRST_SEED} one each"
            )
        rows = rows_of(self.spec, episode)
        pieces = {
            name: self.fields[name].pieces(self._rows, rows[name], (packed_images or {}).get(name)) for name in rows
        }
        # Checksums of JPEG are of the compressed bytes, because decoders differ in rounding.
        jpeg = [name for name in rows if self.codec.of_field(name) == "jpeg"]
        crc = {name: zlib.crc32(pieces[name][0] if name in jpeg else rows[name].data) for name in rows}
        self._commit(self._entry(episode, crc), pieces)

    def fail(self, episode: Episode) -> None:
        """Store the outcome of a failed seed, without rows. Raises as `append` does."""
        self._commit(self._entry(episode, {}), {})

    def _entry(self, episode: Episode, crc: dict[str, int]) -> Entry:
        """Return the index entry of an episode, whose rows are stored if `crc` has their checksums."""
        return Entry(
            seed=episode.seed,
            task=episode.task,
            outcome=episode.outcome,
            milestones=tuple(sorted(episode.milestones)),
            instruction=episode.instruction if crc else "",
            start=self._rows,
            steps=len(episode.actions) if crc else 0,
            draws=dict(episode.draws),
            crc=crc,
        )

    def _commit(self, entry: Entry, pieces: Mapping[str, Sequence[bytes | memoryview]]) -> None:
        """Write an episode: its rows, then its index line, which makes them count."""
        assert self._files, "append and fail work inside `with store.writing()`"
        if self.next_seed not in (None, entry.seed):
            raise UserError(f"{self.folder} expects seed {self.next_seed} next, got seed {entry.seed}")
        line = index_line(entry)
        # Validated as a reader does: nothing is stored that could not be read back.
        entry = parse_line(line[:-1], f"{self.folder}: the entry of seed {entry.seed}")
        try:
            for name, contents in pieces.items():
                for path, content in zip(self.fields[name].files, contents, strict=True):
                    _write(self._files[path], memoryview(content))
            _write(self._files[self._index], memoryview(line))
            self.attempts.append(entry)
            if entry.is_stored and (self._limit is None or len(self.episodes) < self._limit):
                self.episodes.append(entry)
            self._rows += entry.steps
            self._index_size += len(line)
        except OSError as error:
            way_out = f"make room and run again to continue after {counted(len(self.episodes), 'safe episode')}"
            raise UserError(f"{self.folder} cannot take seed {entry.seed} ({error.strerror}): {way_out}") from error
        finally:
            self._cut()  # nothing to do after a success; after an error, or Ctrl-C, what was half written

    def _cut(self) -> None:
        """Truncate all files to what is committed."""
        # The index first: no line may refer to truncated rows at any moment.
        self._files[self._index].truncate(self._index_size)
        for column in self.fields.values():
            for path, size in zip(column.files, column.sizes(self._rows), strict=True):
                self._files[path].truncate(size)

    def _refresh(self) -> None:
        """Read the index, which alone says what the store holds, whatever else the files of the fields contain."""
        files = [column.files[0] for column in self.fields.values()]
        if not self._index.exists() and (orphans := [path for path in files if path.exists()]):
            raise UserError(f"{self._index} is missing, which {orphans[0].name} beside it needs: {REMEDY}")
        self.attempts, self._index_size = read_index(self._index, self.is_derived, self._damaged)
        self.episodes = [entry for entry in self.attempts if entry.is_stored][: self._limit]
        self._rows = max((entry.end for entry in self.attempts), default=0)
        for column in self.fields.values():
            complete_rows = column.count_complete_rows(self._rows)
            if complete_rows < self._rows and not self._damaged:
                raise UserError(f"{column.files[0]} is shorter than its index says: {SALVAGE}")
            self._rows = complete_rows


def rows_of(spec: Spec, episode: Episode) -> dict[str, Array]:
    """Return the rows of an episode, field → (steps, …), see `fields_of`; a UserError if it does not fit the spec."""
    steps = episode.observations
    columns: dict[str, Any] = {"action": episode.actions, "executed": episode.executed}
    try:
        columns["state"] = [step.state for step in steps]
        columns |= {f"rgb_{camera}": [step.rgb[camera] for step in steps] for camera in spec.cameras}
        columns |= {f"depth_{camera}": [step.depth[camera] for step in steps] for camera in spec.depth}
        keys = [name for name, _ in spec.truth]
        columns["truth"] = [np.hstack([np.ravel((step.truth or {})[name]) for name in keys]) for step in steps if keys]
    except KeyError as error:
        raise UserError(f"seed {episode.seed}: an observation lacks {error}, which the spec names") from error
    rows = dict[str, Array]()
    for name, (shape, dtype) in fields_of(spec).items():
        column = np.asarray(columns[name])
        if column.shape != (len(steps), *shape) or not np.can_cast(column.dtype, dtype, "same_kind"):
            raise UserError(f"{name} must be {(len(steps), *shape)} {dtype}, got {column.shape} {column.dtype}")
        rows[name] = np.ascontiguousarray(column, dtype)
        if dtype.kind == "f" and not np.isfinite(rows[name]).all():
            raise UserError(f"seed {episode.seed}: {name} has numbers that are not finite")
    return rows


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


def _checksum(rows: Rows, span: slice, values: Array | None = None) -> int:
    """Return the CRC-32 of the rows in `span`, `values` if they were read already; for JPEG of the compressed bytes."""
    if isinstance(rows, ScatteredRows) and rows.codec == "jpeg":
        return zlib.crc32(b"".join(rows.packed_rows(span)))
    return zlib.crc32((rows[span] if values is None else values).data)


def _write(file: BinaryIO, data: memoryview) -> None:
    while data:  # an unbuffered write may be partial
        data = data[file.write(data) :]
