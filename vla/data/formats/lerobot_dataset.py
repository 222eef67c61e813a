"""A LeRobot dataset on disk, checked as a whole when it is opened.

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.lerobot_episodes import OWNER, Part, read_parts, require_finite
from vla.data.formats.lerobot_tables import MEND, REMEDY, counts, numbers
from vla.data.formats.video import decode, require_video
from vla.data.image_codec import decode_image
from vla.io.documents import read_bounded, read_json
from vla.io.errors import UserError
from vla.io.images import resize
from vla.spec import Array

IMAGES = ("video", "image")
PICTURES = ("PNG", "JPEG", "WEBP")  # formats of images in tables
MOST_COMPONENTS = 10_000  # of a feature; a damaged or hostile file may name any number


class LeRobotDataset:
    """Metadata, instructions and episodes of a dataset, version 3.0.

    Attributes:
        folder: of the dataset.
        info: rate and features.
        images: camera → key of its colour images.
        parts: the episodes in order, of which those with several instructions are several parts.

    Args:
        folder: of the dataset.
        images: camera → key; None: every feature of images, named without `observation.images.`.

    Raises:
        UserError: the dataset is missing, incomplete, damaged, of another version, contradicts itself, names images
            that it does not have, or has several rates.
    """

    def __init__(self, folder: Path, images: Mapping[str, str] | None) -> None:
        self.folder = folder
        self._require_unchanged()
        self.info = self._read_info()
        there = [key for key, feature in self.info.features.items() if feature.dtype in IMAGES and not feature.is_depth]
        self.images = {camera_of(key): key for key in there} if images is None else dict(images)
        if unknown := [key for key in self.images.values() if key not in there]:
            raise UserError(f"expert.images: {folder} has no images {', '.join(unknown)}, it has {', '.join(there)}")
        self.parts = read_parts(folder, self.info, [key for key in self.images.values() if self._is_video(key)])

    def components(self, keys: Sequence[str], anonymous: Sequence[str] = ()) -> dict[str, tuple[str, int]]:
        """Return component → its feature and index, of several features in order.

        Unnamed components are called by `anonymous` if there are as many, else by their feature and index.

        Raises:
            UserError: there is no such feature, or it is no vector of a reasonable size.
        """
        for key in keys:
            if key not in self.info.features or len(self.info.features[key].shape) != 1:
                vectors = [name for name, feature in self.info.features.items() if len(feature.shape) == 1]
                raise UserError(f"{self.folder} has no vector {key}, it has {', '.join(vectors)[:500]}")
            if (size := self.info.features[key].shape[0]) > MOST_COMPONENTS:
                raise UserError(f"{self.folder} has {size} components in {key}, the limit is {MOST_COMPONENTS}")
        named = {key: dict(enumerate(self.info.features[key].components or ())) for key in keys}
        places = [(key, index) for key in keys for index in range(self.info.features[key].shape[0])]
        numbered = {f"{key.rpartition('.')[2]}_{index}" for key, index in places}
        if not any(named.values()) and len(places) == len(anonymous) and not numbered >= {*anonymous}:
            return dict(zip(anonymous, places, strict=True))
        names = [named[key].get(index, f"{key.rpartition('.')[2]}_{index}") for key, index in places]
        if len(set(names)) < len(names):
            names = [f"{key}.{name}" for (key, _), name in zip(places, names, strict=True)]
        if len(set(names)) < len(names):  # within a feature, such as those of two arms
            names = [f"{name}_{index}" for (_, index), name in zip(places, names, strict=True)]
        return dict(zip(names, places, strict=True))

    def read(self, keys: Sequence[str]) -> dict[str, Array]:
        """Read the numbers of features, each (N, D) float32, in the order of the tables.

        Raises:
            UserError: rows are no vectors of finite numbers.
        """
        rows = tables.read(tables.files(self.folder / "data"), dict.fromkeys(keys, numbers) | {OWNER: counts})
        return {key: self._matrix(rows, key) for key in keys}

    def open(self, cameras: Sequence[str], keys: Sequence[str], depth: Sequence[str]) -> None:
        """Load the features `keys`, which `numbers` returns, and check images and the features `depth`.

        Of images in tables and of frames of videos, this decodes the first one of each camera.

        Raises:
            UserError: a file is missing or damaged, or contradicts others.
        """
        self._matrices = self.read(keys)
        images = [self.images[camera] for camera in cameras]
        self._require_videos([key for key in images if self._is_video(key)])
        columns = {key: tables.pictures for key in images if not self._is_video(key)}
        for path in tables.files(self.folder / "data"):
            tables.require(path, columns | dict.fromkeys(depth, tables.pixels))
        for key in images:
            next(self._decoded(self.parts[0], key, 1))

    def numbers(self, key: str, part: Part) -> Array:
        """Return a feature of the whole episode of a part, (N, D) float32."""
        return self._matrices[key][part.rows]

    def frames(self, part: Part, camera: str, size: tuple[int, int], every: int) -> Array:
        """Return every `every`-th image of a part, (N, H, W, 3) uint8, cropped at the centre and resized to `size`.

        Raises:
            UserError: images are missing or damaged.
        """
        images = self._decoded(part, self.images[camera], every)
        return np.stack([resize(image, size, "centre") for image in images])

    def column(self, part: Part, key: str, kind: tables.Kind) -> pa.ChunkedArray:
        """Return the rows of a part in a column that is too large for memory."""
        column = tables.read(part.files, {key: kind}, [(OWNER, "=", part.episode)])[key]
        return column[part.steps]

    def _matrix(self, rows: pa.Table, name: str) -> Array:
        """Return a column of lists as (N, D) float32."""
        size = self.info.features[name].shape[0]
        values = tables.matrix(rows[name], size)
        if values is None or not len(values):
            raise UserError(
                f"{self.folder}/data has rows of {name} without the {size} numbers that meta/info.json states: {MEND}"
            )
        require_finite(self.folder, name, values, rows[OWNER].to_numpy())
        return values

    def _is_video(self, key: str) -> bool:
        return self.info.features[key].dtype == "video"

    def _decoded(self, part: Part, key: str, every: int) -> Iterator[Array]:
        size, count = self.info.features[key].image_size, part.steps.stop - part.steps.start
        if self._is_video(key):
            start = self._begin(part, key) + part.steps.start / self.info.fps
            yield from decode(self._video(part, key), start, count, layout.fraction(self.info.fps), size, every)
            return
        column = self.column(part, key, tables.pictures)
        for step in range(0, count, every):
            try:
                yield decode_image(self._content(column[step].as_py() or {}), PICTURES, (*size, 3))
            except ValueError as error:
                step += part.steps.start
                raise UserError(f"{self.folder}: {key} of episode {part.episode}, step {step}: {error}") from error

    def _begin(self, part: Part, key: str) -> float:
        """Return the time of the first step of an episode in a video [s].

        Time stamps count from where the episode begins in the video. If they begin later than at 0, its first steps
        were cut off, or the stamps are of another clock: then the video does not reach as far as they do.
        """
        begin, end = part.place[f"videos/{key}/from_timestamp"], part.place[f"videos/{key}/to_timestamp"]
        cut, steps = max(round(part.time * self.info.fps), 0), len(part.rows)
        return begin + cut / self.info.fps if begin + (cut + steps - 0.5) / self.info.fps <= end else begin

    def _content(self, picture: Mapping[str, Any]) -> bytes:
        """Return an image file that a cell of a table holds, or names by its path in the folder of the dataset."""
        if picture.get("bytes"):
            return picture["bytes"]
        if not (path := picture.get("path")):
            raise UserError(f"there is no image: {MEND}")
        folder = os.path.realpath(self.folder)
        file = Path(os.path.realpath(os.path.join(folder, str(path))))  # untrusted, it could lead anywhere
        if not file.is_relative_to(folder) or not os.path.isfile(file):
            raise UserError(
                f"the table has no image but the path {str(path)[:200]!r}, which is no file in the folder of the "
                "dataset: copy the images there, or embed them in the tables"
            )
        return read_bounded(file)

    def _video(self, part: Part, key: str) -> Path:
        # The standard path: one that is read from an untrusted file could lead anywhere.
        chunk, file = (part.place[f"videos/{key}/{name}_index"] for name in ("chunk", "file"))
        return self.folder / layout.VIDEOS.format(video_key=key, chunk_index=chunk, file_index=file)

    def _read_info(self) -> layout.Info:
        path = self.folder / "meta/info.json"
        if not path.exists():
            raise UserError(f"there is no LeRobot dataset in {self.folder} (no meta/info.json)")
        try:
            version = str(read_json(path, dict[str, Any]).get("codebase_version"))
        except ValueError as error:
            raise UserError(f"{error}: {REMEDY}") from error
        if version == layout.VERSION:
            return read_json(path, layout.Info)
        known, found = (re.fullmatch(r"v(\d{1,4})\.(\d{1,4})", text) for text in (layout.VERSION, version))
        if found and known and [*map(int, found.groups())] > [*map(int, known.groups())]:
            raise UserError(
                f"{path} has version {version}, newer than {layout.VERSION}, which is read here: look for a newer vla"
            )
        what = f"has version {version}: convert" if found else f"has no version, but {version[:20]}: write or convert"
        raise UserError(f"{path} {what} the dataset to {layout.VERSION} with lerobot")

    def _require_unchanged(self) -> None:
        """Compare the files with their checksums, if the dataset has any."""
        path = self.folder / layout.CHECKSUMS
        if not path.exists():
            return
        try:
            expected, found = read_json(path, layout.Checksums), layout.checksums(self.folder)
        except ValueError as error:
            raise UserError(f"{error}: {REMEDY}") from error
        if changed := [name for name in expected if expected[name] != found.get(name)]:
            raise UserError(
                f"{self.folder} has changed since it was exported, in {', '.join(changed)[:200]}: {REMEDY}, or delete "
                f"{layout.CHECKSUMS} if this was intended"
            )

    def _require_videos(self, keys: Sequence[str]) -> None:
        """Require the videos of all episodes to be there, with the size, the rate and the images that these need."""
        frames: dict[tuple[Path, str], int] = {}
        for part in self.parts:
            for key in keys:
                end = round(self._begin(part, key) * self.info.fps) + len(part.rows)
                place = self._video(part, key), key
                frames[place] = max(frames.get(place, 0), end)
        if missing := [str(path.relative_to(self.folder)) for path, _ in frames if not path.exists()]:
            more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
            raise UserError(f"{self.folder} lacks {', '.join(missing[:3])}{more}: {REMEDY}")
        for (path, key), count in frames.items():
            require_video(path, self.info.features[key].image_size, layout.fraction(self.info.fps), count)


def camera_of(key: str) -> str:
    """Return the camera of a feature of images: its name without `observation.` and `images.`."""
    return key.removeprefix("observation.").removeprefix("images.")
