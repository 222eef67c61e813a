"""Export of an episode store to a smaller one with compressed images."""

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
from vla.data.formats.files import map_episodes, require_empty, staging_folder
from vla.data.header import NAME, Codec, Header, images_of
from vla.data.image_codec import JPEG, OFFSET, pack
from vla.data.index import Entry, index_line
from vla.io.types import Text
from vla.parallel.pool import THIS_PROCESS, Cluster
from vla.spec import Array


@dataclass(frozen=True)
class Pieces:
    """Content that one episode adds to every file."""

    images: dict[str, list[bytes]]  # field → one image per step
    rest: dict[str, Array]  # field → rows
    crc: dict[str, int]


class PackedExporter:
    """Export to a store of individually compressed images, for `collect.folder=DIR` and `inspect.folder=DIR`.

    Depth is compressed without loss; other fields are unchanged. A packed store cannot grow.

    Args:
        folder: of the new store; created when it is complete.
        codec: of colour images: "lossless", or "jpeg", which is smaller for noisy cameras.
        quality: of JPEG, 1…95.
    """

    def __init__(
        self, folder: Text | Path, codec: Literal["lossless", "jpeg"], quality: Annotated[int, Ge(1), Le(95)]
    ) -> None:
        self._folder = Path(folder).resolve()
        self._colour: Codec = "zlib" if codec == "lossless" else "jpeg"
        self._quality = quality

    def export(self, store: EpisodeStore, cluster: Cluster = THIS_PROCESS) -> Path:
        """Write the store atomically; returns the folder.

        Raises:
            ValueError: the folder has other content, or the store is empty, damaged or already lossy.
        """
        store.require_episodes()
        if any(map(store.lossy, store.fields)):
            raise ValueError(f"{store.folder} holds JPEG, which must not be compressed again: pack its source")
        tried = _tried(store)
        header = self._header(store, len(tried))
        with staging_folder(self._folder) as place:
            if _holds(self._folder, header, tried):
                return self._folder
            require_empty(self._folder)
            draft = place / "store"
            shutil.rmtree(draft, ignore_errors=True)  # left by an interrupted export
            draft.mkdir()
            (draft / NAME).write_text(header.text(), encoding="utf-8")
            self._write(draft, store, tried, cluster)
            os.rename(draft, self._folder)
        return self._folder

    def _codecs(self, store: EpisodeStore) -> dict[str, Codec]:
        """Return image field → codec."""
        return {name: self._colour if name.startswith("rgb_") else "zlib" for name in images_of(store.spec)}

    def _header(self, store: EpisodeStore, tried: int) -> Header:
        """Return the header of the new store."""
        quality = self._quality if self._colour == JPEG else None
        config, codecs = _config_of_first(store.config, tried), self._codecs(store)
        return replace(store.header, config=config, packed=codecs, quality=quality)

    def _write(self, folder: Path, store: EpisodeStore, tried: Sequence[Entry], cluster: Cluster) -> None:
        lengths: dict[str, list[int]] = {name: [0] for name in self._codecs(store)}
        lines = []
        with ExitStack() as stack:
            paths = {name: folder / f"{name}.{'pack' if name in lengths else 'bin'}" for name in store.fields}
            files = {name: stack.enter_context(path.open("wb")) for name, path in paths.items()}
            pieces_of = map_episodes(self._pieces, store, range(len(store.episodes)), cluster)
            episodes = stack.enter_context(closing(pieces_of))
            for entry in tried:
                if entry.stored:
                    pieces = next(episodes)
                    entry = replace(entry, crc=pieces.crc)
                    for name, images in pieces.images.items():
                        files[name].writelines(images)
                        lengths[name] += map(len, images)
                    for name, rows in pieces.rest.items():
                        files[name].write(rows.data)
                lines.append(index_line(entry))
            next(episodes, None)  # ends the progress bar
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
    """Return the entries up to the last episode within the limit of `store`, or all of them if it has no limit."""
    shown = store.episodes
    every = len(shown) == sum(entry.stored for entry in store.tried)
    return store.tried if every else store.tried[: store.tried.index(shown[-1]) + 1]


def _config_of_first(config: Mapping[str, Any], tried: int) -> dict[str, Any]:
    """Return the config of the first `tried` entries of a store."""
    if "parts" not in config:
        return dict(config)
    parts = []
    for part in config["parts"]:
        if entries := min(part["entries"], tried):
            parts.append({**part, "entries": entries})
            tried -= entries
    return {**config, "parts": parts}


def _holds(folder: Path, header: Header, tried: Sequence[Entry]) -> bool:
    try:
        there = EpisodeStore(folder)
        same = [replace(entry, crc={}) for entry in there.tried] == [replace(entry, crc={}) for entry in tried]
        return same and there.header == header
    except (OSError, ValueError):  # missing or damaged
        return False
