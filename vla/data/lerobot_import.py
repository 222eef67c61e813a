"""LeRobot datasets as demonstrations to learn from.

Shapes: N steps, J joints, D action components, H by W pixels.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vla.data import lerobot_layout as layout
from vla.data.recorded import Recorded
from vla.data.video import decode
from vla.spec import Array, Episode, Observation, Spec

TOLERANCE = 1e-3  # by which actions may leave the task's bounds, as a share of their range: rounding
REMEDY = "copy the dataset again from where it is whole"


class LeRobot(Recorded):
    """A LeRobot dataset, version 3.0, of the task's kind of step: cameras, image size, joints, actions and rate.

    An episode counts as a success. Where there is no `depth.CAMERA`, depth is 0: no return; where there are no
    `velocities`, they are the differences of the joint positions; where there are no `executed` actions, they are those
    to imitate. What was made up stands in the draws of the episode.

    Args:
        folder: the dataset.
        spec: of the task.

    Raises:
        ValueError: there is no such dataset, it cannot be read, or it differs from the task; the first difference.
    """

    def __init__(self, folder: Path | str | None = None, *, spec: Spec) -> None:
        if folder is None:
            raise ValueError("expert=lerobot needs the folder of a dataset: expert.folder=DIR")
        self._folder, self.spec = Path(folder), spec.perceived
        info = self._read_info()
        there, known = info["features"], layout.features(spec, depth=True)
        self._has_depth = all(there.get(key) == known[key] for key in map(layout.depth_key, spec.cameras))
        extra = [key for key in (layout.EXECUTED, layout.VELOCITIES) if there.get(key) == known[key]]
        self._lacks = [] if self._has_depth else ["depth"]
        self._lacks += [key for key in (layout.EXECUTED, layout.VELOCITIES) if key not in extra]
        columns = ["episode_index", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index"]
        for video in (f"videos/{layout.image_key(camera)}" for camera in spec.cameras):
            columns += [f"{video}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
        self._episodes = self._table("meta/episodes", columns).sort_by("episode_index").to_pylist()
        rows = self._table("data", [layout.STATE, layout.ACTION, *extra, "episode_index", "task_index"])
        self._numbers = {name: self._column(rows, name) for name in (layout.STATE, layout.ACTION, *extra)}
        self._owner, self._task = (rows[name].to_numpy() for name in ("episode_index", "task_index"))
        self._tasks = self._read_tasks()
        self._require_whole()

    def __len__(self) -> int:
        """How many episodes there are."""
        return len(self._episodes)

    def episode(self, number: int) -> Episode:
        """One of them, with its images.

        Raises:
            ValueError: a video is damaged.
        """
        spec, (rows, instruction) = self.spec, self._place(number)
        steps, joints = rows.stop - rows.start, len(spec.joints)
        numbers = {name: values[rows] for name, values in self._numbers.items()}
        state, actions = numbers[layout.STATE], numbers[layout.ACTION]
        differences = np.diff(state[:, :joints], axis=0, prepend=state[:1, :joints]) * np.float32(spec.control_hz)
        velocities = numbers.get(layout.VELOCITIES, differences)
        images = {camera: self._images(number, camera, steps) for camera in spec.cameras}
        depth = {camera: self._depth(number, camera, steps) for camera in spec.cameras}
        observations = [
            Observation(
                rgb={camera: images[camera][step] for camera in spec.cameras},
                depth={camera: depth[camera][step] for camera in spec.cameras},
                joints=state[step, :joints],
                velocities=velocities[step],
                gripper=float(state[step, joints]),
                instruction=instruction,
            )
            for step in range(steps)
        ]
        draws = {"recorded": {"episode": number, "lacks": self._lacks}}
        executed = numbers.get(layout.EXECUTED, actions)
        return Episode(number, instruction, "success", draws, observations, actions, executed)

    def _images(self, number: int, camera: str, steps: int) -> Array:
        """(N, H, W, 3) uint8."""
        key, row = layout.image_key(camera), self._episodes[number]
        chunk, file, start = (row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index", "from_timestamp"))
        # Where the layout has it; a path that stands in somebody's file could lead anywhere.
        path = self._folder / layout.VIDEOS.format(video_key=key, chunk_index=chunk, file_index=file)
        images = decode(path, start, steps, layout.rate(self.spec))
        if images.shape[1:3] != self.spec.image_size:
            raise ValueError(f"{path} has images of {images.shape[1:3]} pixels, not {self.spec.image_size}: {REMEDY}")
        return images

    def _depth(self, number: int, camera: str, steps: int) -> Array:
        """(N, H, W) uint16 [mm]."""
        shape = (steps, *self.spec.image_size)
        if not self._has_depth:
            return np.zeros(shape, np.uint16)
        key, row = layout.depth_key(camera), self._episodes[number]
        path = layout.DATA.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        rows = self._parquet([self._folder / path], [key], [("episode_index", "=", number)])
        values = np.asarray(rows[key].combine_chunks().flatten().flatten(), np.uint16)
        if len(values) != np.prod(shape):
            raise ValueError(f"{self._folder} has {key} of another size in episode {number}: {REMEDY}")
        return values.reshape(shape)

    def _place(self, number: int) -> tuple[slice, str]:
        """Rows and instruction of an episode."""
        row = self._episodes[number]
        rows = slice(row["dataset_from_index"], row["dataset_to_index"])
        tasks = set(self._task[rows].tolist())
        whole = 0 <= rows.start < rows.stop <= len(self._owner) and (self._owner[rows] == number).all()
        if row["episode_index"] != number or not whole or not tasks <= set(self._tasks):
            raise ValueError(f"{self._folder} says of episode {number} what its data does not hold: {REMEDY}")
        if len(tasks) > 1:
            raise ValueError(f"{self._folder} has several tasks in episode {number}: here an episode has one")
        return rows, self._tasks[tasks.pop()]

    def _read_info(self) -> dict[str, Any]:
        path = self._folder / "meta/info.json"
        try:
            info: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if info["codebase_version"] == layout.VERSION:
                self._require_fit(info)
        except FileNotFoundError as error:
            raise ValueError(f"there is no LeRobot dataset in {self._folder} (no meta/info.json)") from error
        except (json.JSONDecodeError, UnicodeDecodeError, LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} cannot be read ({error!r}): {REMEDY}") from error
        if info["codebase_version"] != layout.VERSION:
            version = info["codebase_version"]
            raise ValueError(f"{self._folder} has version {version}: convert it to {layout.VERSION} with lerobot")
        return info

    def _require_fit(self, info: dict[str, Any]) -> None:
        spec, ours, theirs = self.spec, layout.features(self.spec, depth=True), info["features"]
        self._require("a rate of", info["fps"], spec.control_hz)
        for camera in spec.cameras:
            key = layout.image_key(camera)
            if theirs.get(key, {}).get("dtype") != "video":
                videos = [name for name, feature in theirs.items() if feature["dtype"] == "video"]
                raise ValueError(f"{self._folder} has no video {key}, which the task has: it has {', '.join(videos)}")
            self._require(f"{key} of", _size(theirs[key]["shape"]), list(spec.image_size))
        for key in (layout.STATE, layout.ACTION):
            if key not in theirs:
                raise ValueError(f"{self._folder} has no {key}: it has {', '.join(theirs)}")
            self._require(f"{key} of shape", theirs[key]["shape"], ours[key]["shape"])
            names = _names(theirs[key]["names"])
            self._require(f"{key} of", names or ours[key]["names"], ours[key]["names"])

    def _require(self, what: str, theirs: Any, ours: Any) -> None:
        if theirs != ours:
            raise ValueError(f"{self._folder} has {what} {theirs}, but the task has {ours}")

    def _require_whole(self) -> None:
        for number in range(len(self)):
            self._place(number)
        actions = self._numbers[layout.ACTION]
        slack = TOLERANCE * (np.array(self.spec.high) - self.spec.low)
        for index, (name, unit) in enumerate(zip(self.spec.action, self.spec.units, strict=True)):
            low, high = self.spec.low[index], self.spec.high[index]
            least, most = float(actions[:, index].min()), float(actions[:, index].max())
            if least < low - slack[index] or most > high + slack[index]:
                raise ValueError(
                    f"{self._folder} has actions {name} from {least:.3g} to {most:.3g}, the task's are from {low} to "
                    f"{high} {unit}: are they in other units, or absolute?"
                )

    def _column(self, rows: pa.Table, name: str) -> Array:
        """(N, …) float32 of a column of lists."""
        values = np.asarray(rows[name].combine_chunks().flatten(), np.float32)
        size = layout.features(self.spec, depth=True)[name]["shape"][0]
        if len(values) != len(rows) * size or not np.isfinite(values).all():
            raise ValueError(f"{self._folder} has rows of {name} that are not {size} finite numbers: {REMEDY}")
        return values.reshape(len(rows), size)

    def _read_tasks(self) -> dict[int, str]:
        """Index → instruction. What pandas calls the column of instructions depends on who wrote it."""
        table = self._parquet([self._folder / layout.TASKS])
        text = (pa.string(), pa.large_string())
        names = [field.name for field in table.schema if field.type in text]
        if len(names) != 1 or "task_index" not in table.column_names:
            raise ValueError(f"{self._folder}/meta/tasks.parquet has no column of tasks: {REMEDY}")
        return dict(zip(table["task_index"].to_pylist(), table[names[0]].to_pylist(), strict=True))

    def _table(self, name: str, columns: Sequence[str]) -> pa.Table:
        return self._parquet(sorted((self._folder / name).glob("chunk-*/file-*.parquet")), columns)

    def _parquet(self, paths: Sequence[Path], columns: Sequence[str] | None = None, only: Any = None) -> pa.Table:
        try:
            tables = [pq.read_table(path, columns=columns and list(columns), filters=only) for path in paths]
            table = pa.concat_tables(tables)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{self._folder} cannot be read ({error}): {REMEDY}") from error
        if missing := [name for name in columns or () if name not in table.column_names]:
            raise ValueError(f"{self._folder} lacks the columns {', '.join(missing)}: {REMEDY}")
        return table


def _size(shape: Sequence[int]) -> list[int]:
    """Height and width, whether colours come first or last."""
    return list(shape[1:]) if shape[0] == 3 and shape[-1] != 3 else list(shape[:2])


def _names(names: Any) -> list[str] | None:
    """The names of components: a list, a list within a dictionary, or none."""
    return next(iter(names.values()), None) if isinstance(names, dict) else names
