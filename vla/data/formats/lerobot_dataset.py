"""A LeRobot dataset on disk, checked as a whole when it is opened: metadata, episodes, numbers and images.

The rows of an episode are those with its number, in any file: the files and row numbers in the metadata may be out of
date after episodes were merged or deleted.

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.lerobot_images import decode, require_video
from vla.data.formats.lerobot_tables import CORRECTION, COUNTS, NUMBERS, PICTURES, REMEDY, TIMES
from vla.data.index import format_numbers
from vla.io.documents import read_bounded, read_json
from vla.io.errors import UserError
from vla.io.images import decode_image, resize
from vla.spec import LONGEST_INSTRUCTION, Array

IMAGES = ("video", "image")
MAX_COMPONENTS = 10_000  # of a feature; a damaged or hostile file may name any number
OWNER, TASK, TIME, START, END = "episode_index", "task_index", "timestamp", "dataset_from_index", "dataset_to_index"
UNNAMED = "__index_level_0__"  # column of an index that pandas writes without a name


@dataclass(frozen=True)
class Part:
    """Consecutive steps of an episode that have one instruction: all of them, unless its task changes."""

    episode: int  # its number in the dataset
    rows: Array  # (N,) those of the whole episode in the tables
    files: tuple[Path, ...]  # that hold these rows
    steps: slice  # of the part, among those of the episode
    instruction: str  # of the part
    time: float  # stamp of the first step of the episode [s]
    place: Mapping[str, Any]  # files and times of the episode's videos, a row of `meta/episodes`

    def __len__(self) -> int:
        return self.steps.stop - self.steps.start


class LeRobotDataset:
    """Metadata, instructions and episodes of a dataset, version 3.0 (UserError: the dataset is missing, incomplete,
    damaged, of another version, contradicts itself, names images that it does not have, or has several rates).

    Attributes:
        folder: of the dataset.
        info: rate and features.
        images: camera → key of its colour images.
        parts: the episodes in order, of which those with several instructions are several parts.

    Args:
        folder: of the dataset.
        images: camera → key; None: every feature of images, named without `observation.images.`.
    """

    def __init__(self, folder: Path, images: Mapping[str, str] | None) -> None:
        self.folder = folder
        _require_unchanged(folder)
        self.info = _read_info(folder)
        keys = [key for key, feature in self.info.features.items() if feature.dtype in IMAGES and not feature.is_depth]
        cameras = [key.removeprefix("observation.").removeprefix("images.") for key in keys]
        if images is None and len(set(cameras)) < len(cameras):
            raise UserError(
                f"two cameras would have one name in {folder}, which has {', '.join(keys)}: name them, as in "
                f"expert.images={{top: {keys[0]}}}"
            )
        self.images = dict(zip(cameras, keys, strict=True) if images is None else images)
        if extra_keys := [key for key in self.images.values() if key not in keys]:
            raise UserError(f"expert.images: {folder} has no images {', '.join(extra_keys)}, it has {', '.join(keys)}")
        self.parts = self._read_parts([key for key in self.images.values() if self._is_video(key)])

    def components(
        self, keys: Sequence[str], *anonymous: Sequence[str], in_order: bool = False
    ) -> dict[str, tuple[str, int]]:
        """Return component → its feature and index, of several features in order (UserError: there is no such feature,
        or it is no vector of a reasonable size).

        The first names of `anonymous` that are as many as the components name unnamed components, or with `in_order`
        all. Otherwise unnamed components are called by their feature and index.
        """
        features = self.info.features
        vectors = [key for key, feature in features.items() if len(feature.shape) == 1]
        for key in keys:
            if key not in vectors:
                raise UserError(f"{self.folder} has no vector {key}, it has {', '.join(vectors)[:500]}")
            if (size := features[key].shape[0]) > MAX_COMPONENTS:
                raise UserError(f"{self.folder} has {size} components in {key}, the limit is {MAX_COMPONENTS}")
        places = [(key, index) for key in keys for index in range(features[key].shape[0])]
        numbered_names = [f"{key.rpartition('.')[2]}_{index}" for key, index in places]
        given_names = next((names for names in anonymous if len(names) == len(places)), ())
        if in_order and given_names:
            return dict(zip(given_names, places, strict=True))
        if not any(features[key].components for key in keys):
            by_number = not given_names or {*numbered_names} >= {*given_names}
            return dict(zip(numbered_names if by_number else given_names, places, strict=True))
        names_by_place = {(key, index): name for key in keys for index, name in enumerate(features[key].components)}
        names = [names_by_place.get(place, default) for place, default in zip(places, numbered_names, strict=True)]
        if len(set(names)) < len(names):
            names = [f"{key}.{name}" for (key, _), name in zip(places, names, strict=True)]
        if len(set(names)) < len(names):  # within a feature, such as those of two arms
            names = [f"{name}_{index}" for (_, index), name in zip(places, names, strict=True)]
        return dict(zip(names, places, strict=True))

    def read(self, keys: Sequence[str]) -> dict[str, Array]:
        """Read features, each (N, D) float32, in the order of the tables; a UserError if one holds no such numbers."""
        rows = tables.read(tables.files(self.folder / "data"), dict.fromkeys(keys, NUMBERS) | {OWNER: COUNTS})
        arrays = dict[str, Array]()
        for key in keys:
            size = self.info.features[key].shape[0]
            values = tables.vectors(rows[key], size)
            if values is None or not len(values):
                raise UserError(
                    f"{self.folder}/data has rows of {key} without the {size} numbers that meta/info.json states: "
                    f"{CORRECTION}"
                )
            self._require_finite(key, values, rows[OWNER].to_numpy())
            arrays[key] = values
        return arrays

    def require_images(self, cameras: Sequence[str]) -> None:
        """Require the images of cameras; decodes the first one of each camera alone (UserError: a file is missing or
        damaged, or contradicts others)."""
        images = [self.images[camera] for camera in cameras]
        self._require_videos([key for key in images if self._is_video(key)])
        for path in tables.files(self.folder / "data"):
            tables.require(path, {key: PICTURES for key in images if not self._is_video(key)})
        for key in images:
            next(self._decode_images(self.parts[0], key, 1))

    def frames(self, part: Part, camera: str, size: tuple[int, int], every: int) -> Array:
        """Return every `every`-th image of a part, (N, H, W, 3) uint8, cropped at the centre and resized to `size`."""
        images = self._decode_images(part, self.images[camera], every)
        return np.stack([resize(image, size) for image in images])

    def _read_parts(self, videos: Sequence[str]) -> list[Part]:
        """Return the parts of all episodes, in order, with the places of the `videos`, keys of features."""
        episodes, instructions = self._read_episodes(videos), _read_instructions(self.folder / layout.TASKS)
        paths = tables.files(self.folder / "data")
        rows = tables.read(paths, {OWNER: COUNTS, TASK: COUNTS, TIME: NUMBERS})
        file = np.repeat(np.arange(len(paths)), [pq.read_metadata(path).num_rows for path in paths])
        owner, tasks = rows[OWNER].to_numpy(), rows[TASK].to_numpy()
        stamps = tables.vectors(rows[TIME], 1, np.float64)
        if stamps is None:
            raise UserError(f"{self.folder}/data has rows of {TIME} that are not one number: {CORRECTION}")
        self._require_finite(TIME, stamps, owner)
        order, numbers = np.argsort(owner, kind="stable"), [row[OWNER] for row in episodes]
        starts, ends = (np.searchsorted(owner[order], numbers, side) for side in ("left", "right"))
        parts = list[Part]()
        for row, start, end in zip(episodes, starts, ends, strict=True):
            steps, number = order[start:end], row[OWNER]
            times = stamps[steps, 0]
            if len(steps) != (count := row[END] - row[START]) or not count:
                content = f"{len(steps)} steps of episode {number}, and meta/episodes counts {count}"
                raise UserError(f"{self.folder}/data holds {content}: {REMEDY if len(steps) < count else CORRECTION}")
            self._require_even(number, times - times[0])
            files = tuple(paths[index] for index in np.unique(file[steps]))
            # Actions after a change of the task do not follow the instruction before it.
            changes = np.flatnonzero(np.diff(tasks[steps])) + 1
            for begin, stop in pairwise([0, *changes.tolist(), len(steps)]):
                if (task := int(tasks[steps[begin]])) not in instructions:
                    path = self.folder / layout.TASKS
                    raise UserError(f"{path} lacks task {task}, which episode {number} has: {CORRECTION}")
                span = slice(begin, stop)
                parts.append(Part(number, steps, files, span, instructions[task], float(times[0]), row))
        return parts

    def _read_episodes(self, videos: Sequence[str]) -> list[dict[str, Any]]:
        """Return the rows of `meta/episodes`, in the order of the episodes."""
        folder, columns = self.folder / "meta/episodes", dict.fromkeys((OWNER, START, END), COUNTS)
        for video in (f"videos/{key}" for key in videos):
            columns |= {f"{video}/chunk_index": COUNTS, f"{video}/file_index": COUNTS}
            columns |= {f"{video}/from_timestamp": TIMES, f"{video}/to_timestamp": TIMES}
        rows = tables.read(tables.files(folder), columns).sort_by(OWNER).to_pylist()
        if duplicates := [row[OWNER] for row, next_row in pairwise(rows) if row[OWNER] == next_row[OWNER]]:
            raise UserError(f"{folder} lists episode {duplicates[0]} more than once: {CORRECTION}")
        # An incomplete copy has the totals of the whole dataset; more episodes than in the totals are no damage.
        counts = (
            ("episodes", len(rows), self.info.total_episodes),
            ("frames", sum(row[END] - row[START] for row in rows), self.info.total_frames),
        )
        for noun, count, total in counts:
            if count < total:
                raise UserError(
                    f"{folder} lists {count} of the {total} {noun} that meta/info.json counts: {REMEDY}, or correct "
                    f"total_{noun} there if the others were left out on purpose"
                )
        if not rows:
            raise UserError(f"{self.folder} has no episodes: record some first")
        return rows

    def _is_video(self, key: str) -> bool:
        return self.info.features[key].dtype == "video"

    def _decode_images(self, part: Part, key: str, every: int) -> Iterator[Array]:
        size = self.info.features[key].image_size
        if self._is_video(key):
            start, fps = self._start_time(part, key) + part.steps.start / self.info.fps, layout.fraction(self.info.fps)
            yield from decode(self._video(part, key), start, len(part), fps, size, every)
            return
        column = tables.read(part.files, {key: PICTURES}, [(OWNER, "=", part.episode)])[key][part.steps]
        for step in range(0, len(part), every):
            try:
                yield decode_image(self._content(column[step].as_py() or {}), size)
            except UserError as error:
                step += part.steps.start
                raise UserError(f"{self.folder}: {key} of episode {part.episode}, step {step}: {error}") from error

    def _start_time(self, part: Part, key: str) -> float:
        """Return the time of the first step of an episode in a video [s].

        Time stamps count from where the episode begins in the video. If they begin later than at 0, its first steps
        were cut off, or the stamps are of another clock: then the video does not reach as far as they do.
        """
        begin, end = part.place[f"videos/{key}/from_timestamp"], part.place[f"videos/{key}/to_timestamp"]
        offset, steps = max(float(np.rint(part.time * self.info.fps)), 0.0), len(part.rows)
        return begin + offset / self.info.fps if begin + (offset + steps - 0.5) / self.info.fps <= end else begin

    def _content(self, picture: Mapping[str, Any]) -> bytes:
        """Return an image file that a cell of a table holds, or names by its path in the folder of the dataset."""
        if picture.get("bytes"):
            return picture["bytes"]
        if not (path := str(picture.get("path") or "").replace("\0", "")):  # which no path has
            raise UserError(f"there is no image: {CORRECTION}")
        folder = os.path.realpath(self.folder)
        file = Path(os.path.realpath(os.path.join(folder, path)))  # untrusted, it could lead anywhere
        if not file.is_relative_to(folder) or not os.path.isfile(file):
            raise UserError(
                f"the table has no image but the path {path[:200]!r}, which is no file in the folder of the "
                "dataset: copy the images there, or embed them in the tables"
            )
        return read_bounded(file)

    def _video(self, part: Part, key: str) -> Path:
        # The standard path: one that is read from an untrusted file could lead anywhere.
        chunk, file = (part.place[f"videos/{key}/{name}_index"] for name in ("chunk", "file"))
        return self.folder / layout.VIDEOS.format(video_key=key, chunk_index=chunk, file_index=file)

    def _require_videos(self, keys: Sequence[str]) -> None:
        """Require the videos of all episodes to exist, with the size, rate and number of images that these need."""
        frames: dict[tuple[Path, str], int] = {}
        for part in self.parts:
            for key in keys:
                end = round(self._start_time(part, key) * self.info.fps) + len(part.rows)
                place = self._video(part, key), key
                frames[place] = max(frames.get(place, 0), end)
        if missing_files := [str(path.relative_to(self.folder)) for path, _ in frames if not path.exists()]:
            suffix = f" and {len(missing_files) - 3} more" if len(missing_files) > 3 else ""
            raise UserError(f"{self.folder} lacks {', '.join(missing_files[:3])}{suffix}: {REMEDY}")
        for (path, key), count in frames.items():
            require_video(path, self.info.features[key].image_size, layout.fraction(self.info.fps), count)

    def _require_even(self, number: int, times: Array) -> None:
        """Require the times of an episode, counted from its first step, to follow the frame rate without gaps."""
        fps, steps = self.info.fps, np.arange(len(times))
        deviations = np.abs(times - steps / fps) > (0.5 + layout.RATE_TOLERANCE * steps) / fps
        deviations |= np.abs(np.diff(times, prepend=-1 / fps) - 1 / fps) > 0.5 / fps  # a step that was left out
        if deviations.any():
            step = int(np.argmax(deviations))
            raise UserError(
                f"{self.folder}: step {step} of episode {number} comes {times[step]:.4g} s after its first one, but at "
                f"{fps:g} Hz, the rate in meta/info.json, it is {step / fps:.4g} s: correct fps there, or record all "
                "episodes at one rate without gaps"
            )

    def _require_finite(self, name: str, values: Array, owner: Array) -> None:
        """Require the rows (N, D) of a feature to be finite; `owner` (N,) are their episodes."""
        if len(positions := np.argwhere(~np.isfinite(values))):
            row, at = positions[0]
            step, steps = (owner[:row] == owner[row]).sum(), len(set(positions[:, 0]))
            raise UserError(
                f"{self.folder}: {name} is {values[row, at]} at index {at} in episode {owner[row]}, step {step}, the "
                f"first of {steps} such steps: correct the numbers, or delete the episodes with lerobot-edit-dataset"
            )


def _read_info(folder: Path) -> layout.Info:
    path = folder / "meta/info.json"
    if not path.exists():
        raise UserError(
            f"there is no LeRobot dataset in {folder} (no meta/info.json); one of the hub is downloaded by: "
            "hf download --repo-type dataset OWNER/NAME --local-dir FOLDER"
        )
    try:
        version = str(read_json(path, dict[str, Any]).get("codebase_version"))
    except UserError as error:
        raise UserError(f"{error}: {REMEDY}") from error
    if version == layout.VERSION:
        return read_json(path, layout.Info)
    raise UserError(
        f"{path} has version {version[:20]}, and {layout.VERSION} is read here: convert an older dataset with lerobot"
    )


def _read_instructions(path: Path) -> dict[int, str]:
    """Return task index → instruction; the name of the column of instructions depends on the writer."""
    schema = tables.schema_of(path)
    texts = [field.name for field in schema if tables.is_text(field.type)]
    columns = [name for name in (UNNAMED, "task") if name in texts] or (texts if len(texts) == 1 else [])
    if not columns:
        raise UserError(
            f"{path} has the columns {', '.join(schema.names)[:200]}, but no column task of texts: {CORRECTION}"
        )
    table = tables.read([path], {TASK: COUNTS, columns[0]: tables.TEXTS})
    tasks = dict(zip(table[TASK].to_pylist(), table[columns[0]].to_pylist(), strict=True))
    if indices := [index for index, text in tasks.items() if len(text) > LONGEST_INSTRUCTION]:
        raise UserError(
            f"{path}: shorten the tasks {format_numbers(indices)}, of more than {LONGEST_INSTRUCTION} characters"
        )
    return tasks


def _require_unchanged(folder: Path) -> None:
    """Compare the files with their checksums, if the dataset has any."""
    path = folder / layout.CHECKSUMS
    if not path.exists():
        return
    try:
        saved_checksums, checksums = read_json(path, layout.Checksums), layout.checksums(folder)
    except UserError as error:
        raise UserError(f"{error}: {REMEDY}") from error
    if changed_files := [name for name in saved_checksums if saved_checksums[name] != checksums.get(name)]:
        raise UserError(
            f"{folder} has changed since it was exported, in {', '.join(changed_files)[:200]}: {REMEDY}, or delete "
            f"{layout.CHECKSUMS} if this was intended"
        )
