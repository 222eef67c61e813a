"""A LeRobot dataset on disk, checked as a whole when it is opened.

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.lerobot_tables import REMEDY, counts, numbers
from vla.data.formats.video import decode, require_video
from vla.data.image_codec import decode_image
from vla.data.index import listed
from vla.io.documents import read_json
from vla.io.images import resize
from vla.spec import LONGEST_INSTRUCTION, Array

COLUMNS = {"episode_index": counts, "task_index": counts, "frame_index": counts, "timestamp": numbers}
IMAGES = ("video", "image")
MOST_COMPONENTS = 10_000  # of a feature; a damaged or hostile file may name any number


class LeRobotDataset:
    """Metadata, instructions and episodes of a dataset, version 3.0.

    Attributes:
        folder: of the dataset.
        info: rate and features.
        images: camera → key of its colour images.

    Args:
        folder: of the dataset.
        images: camera → key; None: every feature of images, named without `observation.images.`.

    Raises:
        ValueError: the dataset is missing, damaged, of another version, or names images that it does not have.
    """

    def __init__(self, folder: Path, images: Mapping[str, str] | None) -> None:
        self.folder = folder
        self._require_unchanged()
        self.info = self._read_info()
        there = [key for key, feature in self.info.features.items() if feature.dtype in IMAGES and not feature.is_depth]
        self.images = {camera_of(key): key for key in there} if images is None else dict(images)
        if unknown := [key for key in self.images.values() if key not in there]:
            raise ValueError(f"expert.images: {folder} has no images {', '.join(unknown)}, it has {', '.join(there)}")

    def components(self, keys: Sequence[str], anonymous: Sequence[str] = ()) -> dict[str, tuple[str, int]]:
        """Return component → its feature and index, of several features in order.

        Unnamed components are called by `anonymous` if there are as many, else by their feature and index.

        Raises:
            ValueError: there is no such feature, or it is no vector of a reasonable size.
        """
        for key in keys:
            if key not in self.info.features or len(self.info.features[key].shape) != 1:
                vectors = [name for name, feature in self.info.features.items() if len(feature.shape) == 1]
                raise ValueError(f"{self.folder} has no vector {key}, it has {', '.join(vectors)[:500]}")
            if (size := self.info.features[key].shape[0]) > MOST_COMPONENTS:
                raise ValueError(f"{self.folder} has {size} components in {key}, the limit is {MOST_COMPONENTS}")
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
        """Read the numbers of features, each (N, D) float32, before anything else is checked."""
        rows = self.table("data", dict.fromkeys(keys, numbers))
        return {key: self.matrix(rows, key) for key in keys}

    def open(self, cameras: Sequence[str], keys: Sequence[str]) -> None:
        """Load the features `keys`, whose rows `numbers` returns, and check all files that the episodes need.

        Raises:
            ValueError: a file is missing, damaged or contradicts others; or the frames have several rates.
        """
        self._videos = [
            key for key in (self.images[camera] for camera in cameras) if self.info.features[key].dtype == "video"
        ]
        self._require_one_rate()
        self._rows_of_episodes = self._read_episodes()
        self._require_files()
        rows = self.table("data", dict.fromkeys(keys, numbers) | COLUMNS)
        self._matrices = {key: self.matrix(rows, key) for key in keys}
        self._owner, self._task = (rows[name].to_numpy() for name in ("episode_index", "task_index"))
        self._require_even(rows)
        self._tasks = self._read_tasks()
        for number in range(len(self)):
            self.place(number)
        self._require_videos()

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._rows_of_episodes)

    def place(self, number: int) -> tuple[slice, str]:
        """Return the row range and the instruction of an episode."""
        row = self._rows_of_episodes[number]
        rows = slice(row["dataset_from_index"], row["dataset_to_index"])
        tasks = set(self._task[rows].tolist())
        whole = 0 <= rows.start < rows.stop <= len(self._owner) and (self._owner[rows] == number).all()
        if row["episode_index"] != number or not whole or not tasks <= set(self._tasks):
            raise ValueError(f"{self.folder}: the metadata of episode {number} contradicts the data: {REMEDY}")
        if len(tasks) > 1:
            raise ValueError(f"{self.folder} has several tasks in episode {number}: only one is supported")
        return rows, self._tasks[tasks.pop()]

    def numbers(self, key: str, rows: slice) -> Array:
        """Return rows of a feature, (N, D) float32."""
        return self._matrices[key][rows]

    def frames(self, number: int, camera: str, size: tuple[int, int], every: int) -> Array:
        """Return every `every`-th image of an episode, (N, H, W, 3) uint8, cropped at the centre and resized to `size`.

        Raises:
            ValueError: images are missing or damaged.
        """
        key, (rows, _) = self.images[camera], self.place(number)
        images = self._decoded(number, key, rows.stop - rows.start, every)
        return np.stack([resize(image, size, "centre") for image in images])

    def column(self, number: int, key: str, kind: tables.Kind) -> tuple[Path, pa.ChunkedArray]:
        """Return the rows of an episode in a column that is too large for memory, and their file."""
        path = self.folder / _place(layout.DATA, self._rows_of_episodes[number], "data")
        return path, tables.read([path], {key: kind}, [("episode_index", "=", number)])[key]

    def table(self, name: str, columns: Mapping[str, tables.Kind]) -> pa.Table:
        """Return columns of all files of a table, `data` or `meta/episodes`."""
        paths = sorted((self.folder / name).glob("chunk-*/file-*.parquet"))
        if not paths:
            raise ValueError(f"{self.folder / name} holds no tables: {REMEDY}")
        return tables.read(paths, columns)

    def matrix(self, rows: pa.Table, name: str) -> Array:
        """Return a column of lists as (N, D) float32."""
        size = self.info.features[name].shape[0]
        values = tables.matrix(rows[name], size)
        if values is None or not len(values):
            raise ValueError(f"{self.folder}/data has rows of {name} that are not {size} finite numbers: {REMEDY}")
        return values

    def _decoded(self, number: int, key: str, steps: int, every: int) -> Iterator[Array]:
        size = self.info.features[key].image_size
        if key not in self._videos:
            yield from self._pictures(number, key, steps, size, every)
            return
        row = self._rows_of_episodes[number]
        start = row[f"videos/{key}/from_timestamp"]
        yield from decode(self._video(row, key), start, steps, layout.fraction(self.info.fps), size, every)

    def _pictures(self, number: int, key: str, steps: int, size: tuple[int, int], every: int) -> Iterator[Array]:
        """Yield images in the table; their paths are not followed."""
        path, column = self.column(number, key, tables.pictures)
        if len(column) != steps:
            raise ValueError(f"{path} lacks images {key} of episode {number}: {REMEDY}")
        for step in range(0, steps, every):
            content = (column[step].as_py() or {}).get("bytes")
            if not content:
                raise ValueError(f"{path} lacks images {key} of episode {number}: {REMEDY}")
            try:
                yield decode_image(content, "PNG", (*size, 3))
            except ValueError as error:
                raise ValueError(f"{path}: {key} of episode {number}: {error}: {REMEDY}") from error

    def _video(self, row: Mapping[str, Any], key: str) -> Path:
        # The standard path: one that is read from an untrusted file could lead anywhere.
        return self.folder / _place(layout.VIDEOS, row, f"videos/{key}", video_key=key)

    def _read_info(self) -> layout.Info:
        path = self.folder / "meta/info.json"
        if not path.exists():
            raise ValueError(f"there is no LeRobot dataset in {self.folder} (no meta/info.json)")
        try:
            version = read_json(path, dict[str, Any]).get("codebase_version")
            if version == layout.VERSION:
                return read_json(path, layout.Info)
        except ValueError as error:
            raise ValueError(f"{error}: {REMEDY}") from error
        raise ValueError(
            f"{path} has version {str(version)[:20]}: convert the dataset to {layout.VERSION} with lerobot"
        )

    def _require_unchanged(self) -> None:
        """Compare the files with their checksums, if the dataset has any."""
        path = self.folder / layout.CHECKSUMS
        if not path.exists():
            return
        try:
            expected, found = read_json(path, layout.Checksums), layout.checksums(self.folder)
        except ValueError as error:
            raise ValueError(f"{error}: {REMEDY}") from error
        if changed := [name for name in expected if expected[name] != found.get(name)]:
            raise ValueError(
                f"{self.folder} has changed since it was exported, in {', '.join(changed)[:200]}: {REMEDY}, or delete "
                f"{layout.CHECKSUMS} if this was intended"
            )

    def _require_one_rate(self) -> None:
        rates = {key: self.info.features[key].video_rate for key in self._videos}
        if others := [f"{key} {str(rate)[:20]} Hz" for key, rate in rates.items() if rate not in (None, self.info.fps)]:
            raise ValueError(
                f"{self.folder} has {self.info.fps:g} Hz, but {', '.join(others)}: record all cameras at one rate"
            )

    def _require_even(self, rows: pa.Table) -> None:
        """Require the time stamps to follow the rate."""
        times, frames = tables.matrix(rows["timestamp"], 1), rows["frame_index"].to_numpy()
        if times is None:
            raise ValueError(f"{self.folder}/data has rows of timestamp that are not finite numbers: {REMEDY}")
        off = np.flatnonzero(np.abs(times[:, 0] - frames / self.info.fps) > 0.5 / self.info.fps)
        if len(off):
            raise ValueError(
                f"{self.folder} has time stamps in episode {self._owner[off[0]]} that do not follow its rate of "
                f"{self.info.fps:g} Hz: record all episodes at one rate"
            )

    def _require_files(self) -> None:
        """Require the files that the episodes name."""
        needed = {
            **{_place(layout.DATA, row, "data"): None for row in self._rows_of_episodes},
            **{
                self._video(row, key).relative_to(self.folder).as_posix(): None
                for key in self._videos
                for row in self._rows_of_episodes
            },
        }
        if missing := [name for name in needed if not (self.folder / name).exists()]:
            more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
            raise ValueError(f"{self.folder} lacks {', '.join(missing[:3])}{more}: {REMEDY}")

    def _require_videos(self) -> None:
        """Require size, rate and length of the videos."""
        frames: dict[tuple[Path, str], int] = {}
        for row in self._rows_of_episodes:
            steps = row["dataset_to_index"] - row["dataset_from_index"]
            for key in self._videos:
                end = round(row[f"videos/{key}/from_timestamp"] * self.info.fps) + steps
                place = self._video(row, key), key
                frames[place] = max(frames.get(place, 0), end)
        for (path, key), count in frames.items():
            require_video(path, self.info.features[key].image_size, layout.fraction(self.info.fps), count)

    def _read_episodes(self) -> list[dict[str, Any]]:
        """Return the rows of `meta/episodes`, in the order of the episodes."""
        names = ("episode_index", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")
        columns = dict.fromkeys(names, counts)
        for video in (f"videos/{key}" for key in self._videos):
            columns |= {f"{video}/chunk_index": counts, f"{video}/file_index": counts}
            columns |= {f"{video}/from_timestamp": tables.times}
        return self.table("meta/episodes", columns).sort_by("episode_index").to_pylist()

    def _read_tasks(self) -> dict[int, str]:
        """Return index → instruction; the name of the column of instructions depends on the writer."""
        path = self.folder / layout.TASKS
        columns = tables.columns_of(path)
        names = [name for name in columns if name != "task_index"]
        if len(names) != 1:
            raise ValueError(f"{path} has the columns {', '.join(columns)[:200]}, not one of tasks and task_index")
        table = tables.read([path], {"task_index": counts, names[0]: tables.texts})
        found = dict(zip(table["task_index"].to_pylist(), table[names[0]].to_pylist(), strict=True))
        if longer := [index for index, text in found.items() if len(text) > LONGEST_INSTRUCTION]:
            raise ValueError(f"{path} has tasks of more than {LONGEST_INSTRUCTION} characters: {listed(longer)}")
        return found


def camera_of(key: str) -> str:
    """Return the camera of a feature of images: its name without `observation.` and `images.`."""
    return key.removeprefix("observation.").removeprefix("images.")


def _place(pattern: str, row: Mapping[str, Any], of: str, **names: str) -> str:
    """Return the path of the file in which an episode's part `of` is, given its row of metadata."""
    return pattern.format(chunk_index=row[f"{of}/chunk_index"], file_index=row[f"{of}/file_index"], **names)
