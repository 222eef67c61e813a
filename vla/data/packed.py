"""Export of an episode store to a smaller one that is read in its place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from vla.data.episodes import EpisodeStore, checksums
from vla.data.export import each, require_empty, unfinished
from vla.data.header import NAME, Codec, Header
from vla.data.index import Entry, index_line
from vla.data.pack import JPEG, OFFSET, pack
from vla.spec import Array
from vla.types import Count, Text


@dataclass(frozen=True)
class Pieces:
    """What one episode adds to every file."""

    images: dict[str, list[bytes]]  # field → an image per step
    rest: dict[str, Array]  # field → rows
    crc: dict[str, int]


class Packed:
    """A store whose images are compressed one by one, for `collect.folder=DIR` and `inspect.folder=DIR`.

    Depth is packed without loss, everything else stays as it is. Such a store does not grow.

    Args:
        folder: where to write; it appears when all of it is there.
        codec: of colour images: "lossless", or "jpeg", which is smaller where cameras are noisy.
        quality: of JPEG, 1…95; images without loss have none.
        workers: processes; null: one per core. The files do not depend on it.
    """

    def __init__(
        self,
        folder: Text | Path,
        codec: Literal["lossless", "jpeg"] = "lossless",
        quality: Annotated[int, Ge(1), Le(100)] = 90,
        workers: Count | None = None,
    ) -> None:
        if quality > 95:
            raise ValueError(f"export.quality is from 1 to 95, not {quality}")
        self._folder, self._workers = Path(folder).resolve(), workers
        self._colour: Codec = "zlib" if codec == "lossless" else "jpeg"
        self._quality = quality

    def export(self, store: EpisodeStore) -> Path:
        """Write the store, all of it or nothing; returns the folder.

        Raises:
            ValueError: the folder holds something else, or the store is empty, damaged, or of JPEG itself.
        """
        if not store.episodes:
            raise ValueError(f"{store.folder} holds no episodes yet: collect some first")
        if any(map(store.lossy, store.fields)):
            raise ValueError(f"{store.folder} holds JPEG, which gets no better: pack the store that it was made of")
        tried = _tried(store)
        header = self._header(store, len(tried))
        with unfinished(self._folder) as place:
            if _is_of(self._folder, header, tried):
                return self._folder
            require_empty(self._folder)
            draft = place / "store"
            shutil.rmtree(draft, ignore_errors=True)  # left by an export that was cut short
            draft.mkdir()
            (draft / NAME).write_text(header.text(), encoding="utf-8")
            self._write(draft, store, tried)
            os.rename(draft, self._folder)
        return self._folder

    def _codecs(self, store: EpisodeStore) -> dict[str, Codec]:
        """Field of images → how they are packed."""
        codecs: dict[str, Codec] = {f"rgb_{camera}": self._colour for camera in store.spec.cameras}
        codecs |= {f"depth_{camera}": "zlib" for camera in store.spec.cameras}
        return codecs

    def _header(self, store: EpisodeStore, tried: int) -> Header:
        """What `store.json` of the new store says."""
        quality = self._quality if self._colour == JPEG else None
        return replace(store.header, config=_first(store.config, tried), packed=self._codecs(store), quality=quality)

    def _write(self, folder: Path, store: EpisodeStore, tried: Sequence[Entry]) -> None:
        lengths: dict[str, list[int]] = {name: [0] for name in self._codecs(store)}
        lines = []
        with ExitStack() as stack:
            paths = {name: folder / f"{name}.{'pack' if name in lengths else 'bin'}" for name in store.fields}
            files = {name: stack.enter_context(path.open("wb")) for name, path in paths.items()}
            pieces_of = each(self._pieces, store, range(len(store.episodes)), self._workers)
            episodes = stack.enter_context(closing(pieces_of))
            for entry in tried:
                if entry.success:
                    pieces = next(episodes)
                    entry = replace(entry, crc=pieces.crc)
                    for name, images in pieces.images.items():
                        files[name].writelines(images)
                        lengths[name] += map(len, images)
                    for name, rows in pieces.rest.items():
                        files[name].write(rows.data)
                lines.append(index_line(entry))
            next(episodes, None)  # the progress bar ends
        for name, sizes in lengths.items():
            np.cumsum(sizes).astype(OFFSET).tofile(folder / f"{name}.offsets")
        (folder / "index.jsonl").write_bytes(b"".join(lines))

    def _pieces(self, store: EpisodeStore, number: int) -> Pieces:
        rows = store.read(store.episodes[number])
        codecs = self._codecs(store)
        images = {name: [pack(image, codec, self._quality) for image in rows[name]] for name, codec in codecs.items()}
        rest = {name: values for name, values in rows.items() if name not in images}
        lossy = {name: np.frombuffer(b"".join(images[name]), np.uint8) for name in images if codecs[name] == JPEG}
        return Pieces(images, rest, checksums(rows | lossy))


def _tried(store: EpisodeStore) -> list[Entry]:
    """The entries up to the last episode that `store` shows; all of them if it shows all."""
    shown = store.episodes
    every = len(shown) == sum(entry.success for entry in store.tried)
    return store.tried if every else store.tried[: store.tried.index(shown[-1]) + 1]


def _first(config: Mapping[str, Any], tried: int) -> dict[str, Any]:
    """The config of the first so many entries of a store."""
    if "parts" not in config:
        return dict(config)
    parts = []
    for part in config["parts"]:
        if entries := min(part["entries"], tried):
            parts.append({**part, "entries": entries})
            tried -= entries
    return {**config, "parts": parts}


def _is_of(folder: Path, header: Header, tried: Sequence[Entry]) -> bool:
    try:
        there = EpisodeStore(folder)
        same = [replace(entry, crc={}) for entry in there.tried] == [replace(entry, crc={}) for entry in tried]
        return same and there.header == header
    except (OSError, ValueError):  # not there, or damaged
        return False
