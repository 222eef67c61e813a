"""Import of LeRobot datasets as demonstrations.

Shapes: N steps, P state components, D action components, H by W pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vla.data.episodes import observations_of
from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.imported_demonstrations import ImportedDemonstrations
from vla.data.formats.lerobot_compatibility import mismatches, out_of_bounds
from vla.data.formats.lerobot_tables import REMEDY, counts, numbers
from vla.data.formats.video import decode
from vla.data.image_codec import decode_image
from vla.data.index import listed
from vla.io.documents import read_json
from vla.spec import LONGEST_INSTRUCTION, Array, Episode, Spec


class LeRobotDemonstrations(ImportedDemonstrations):
    """Episodes of a LeRobot dataset, version 3.0, whose cameras, image size, state, actions and rate match the task.

    Images are videos, or PNG within the tables. Every episode is a success. Missing features are filled in: depth
    by 0 (no return), `velocities` of the robot by differences of its joint positions, `executed` by the actions to
    imitate. The draws of the episode list them.

    Args:
        folder: of the dataset.
        spec: of the task.

    Raises:
        ValueError: the dataset is missing or damaged, or differs from the task; the message lists all differences.
    """

    def __init__(self, folder: Path | str | None, *, spec: Spec) -> None:
        if folder is None:
            raise ValueError("expert=lerobot needs the folder of a dataset: expert.folder=DIR")
        self._folder, self.spec = Path(folder), spec.without_truth
        self._require_unchanged()
        info = self._read_info()
        self._require_fit(info)
        known = layout.features(spec, depth=True)

        def has(key: str) -> bool:
            there = info.features.get(key)
            return there is not None and there == layout.Feature(
                known[key]["dtype"], tuple(known[key]["shape"]), known[key]["names"]
            )

        wanted = [key for key in (layout.EXECUTED, layout.RATES) if key in known]
        extra = [key for key in wanted if has(key)]
        self._has_depth = all(has(layout.depth_key(camera)) for camera in spec.depth)
        self._lacks = [] if self._has_depth else ["depth"]
        self._lacks += [key for key in wanted if key not in extra]
        self._require_rates()
        kinds = {camera: info.features[layout.image_key(camera)].dtype for camera in spec.cameras}
        self._videos = [camera for camera, kind in kinds.items() if kind == "video"]
        self._episodes = self._read_episodes()
        rows = self._rows([layout.STATE, layout.ACTION, *extra])
        self._numbers = {name: self._matrix(rows, name) for name in (layout.STATE, layout.ACTION, *extra)}
        self._owner, self._task = (rows[name].to_numpy() for name in ("episode_index", "task_index"))
        self._tasks = self._read_tasks()
        for number in range(len(self)):
            self._place(number)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._episodes)

    def episode(self, number: int) -> Episode:
        """Return one episode, with its images.

        Raises:
            ValueError: images are damaged.
        """
        spec, (rows, instruction) = self.spec, self._place(number)
        steps = rows.stop - rows.start
        numbers = {name: values[rows] for name, values in self._numbers.items()}
        actions = numbers[layout.ACTION]
        images = {f"rgb_{camera}": self._images(number, camera, steps) for camera in spec.cameras}
        images |= {f"depth_{camera}": self._depth(number, camera, steps) for camera in spec.depth}
        observations = observations_of(spec, {**images, "state": self._state(numbers)}, instruction)
        draws = {"recorded": {"episode": number, "lacks": self._lacks}}
        executed = numbers.get(layout.EXECUTED, actions)
        what = (number, "recorded", instruction, "success", frozenset[str](), draws)
        return Episode(*what, observations, actions, executed)

    def _state(self, numbers: Mapping[str, Array]) -> Array:
        """Return (N, P) float32; joint velocities are differences of positions if the dataset has none."""
        spec = self.spec
        state = np.empty((len(numbers[layout.STATE]), len(spec.state)), np.float32)
        state[:, spec.pose] = numbers[layout.STATE]
        if layout.RATES in numbers:
            state[:, spec.rates] = numbers[layout.RATES]
        elif spec.rates and spec.robot is not None:
            joints = state[:, spec.indices(spec.robot.joints)]
            differences = np.diff(joints, axis=0, prepend=joints[:1]) * np.float32(spec.control_hz)
            state[:, spec.indices(spec.robot.velocities)] = differences
        return state

    def _require_rates(self) -> None:
        """Require the rates of change that cannot be computed from joint positions."""
        spec = self.spec
        given = spec.robot.velocities if spec.robot else ()
        missing = [spec.state[index] for index in spec.rates if spec.state[index] not in given]
        if layout.RATES in self._lacks and missing:
            raise ValueError(f"{self._folder} has no {layout.RATES}, which the task has as {', '.join(missing)}")

    def _images(self, number: int, camera: str, steps: int) -> Array:
        """Return (N, H, W, 3) uint8."""
        key, row = layout.image_key(camera), self._episodes[number]
        if camera not in self._videos:
            return self._pictures(number, key, steps)
        chunk, file, start = (row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index", "from_timestamp"))
        # The standard path: one that is read from an untrusted file could lead anywhere.
        path = self._folder / layout.VIDEOS.format(video_key=key, chunk_index=chunk, file_index=file)
        return decode(path, start, steps, layout.rate(self.spec), self.spec.image_size)

    def _pictures(self, number: int, key: str, steps: int) -> Array:
        """Return (N, H, W, 3) uint8 of images in the table; their paths are not followed."""
        path, column = self._column(number, key, tables.pictures)
        contents = [one and one["bytes"] for one in column.to_pylist()]
        if len(contents) != steps or not all(contents):
            raise ValueError(f"{path} lacks images {key} of episode {number}: {REMEDY}")
        try:
            return np.stack([decode_image(content, "PNG", (*self.spec.image_size, 3)) for content in contents])
        except ValueError as error:
            raise ValueError(f"{path}: {key} of episode {number}: {error}: {REMEDY}") from error

    def _depth(self, number: int, camera: str, steps: int) -> Array:
        """Return (N, H, W) uint16 [mm]."""
        shape = (steps, *self.spec.image_size)
        if not self._has_depth:
            return np.zeros(shape, np.uint16)
        path, column = self._column(number, layout.depth_key(camera), tables.pixels)
        values = np.asarray(column.combine_chunks().flatten().flatten())
        if values.dtype != np.uint16 or len(values) != np.prod(shape):
            raise ValueError(f"{path} has {layout.depth_key(camera)} of another size in episode {number}: {REMEDY}")
        return values.reshape(shape)

    def _column(self, number: int, key: str, kind: tables.Kind) -> tuple[Path, pa.ChunkedArray]:
        """Return the rows of an episode in a column that is too large for memory, and their file."""
        row = self._episodes[number]
        path = layout.DATA.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        only = [("episode_index", "=", number)]
        return self._folder / path, tables.read([self._folder / path], {key: kind}, only)[key]

    def _place(self, number: int) -> tuple[slice, str]:
        """Return the row range and the instruction of an episode."""
        row = self._episodes[number]
        rows = slice(row["dataset_from_index"], row["dataset_to_index"])
        tasks = set(self._task[rows].tolist())
        whole = 0 <= rows.start < rows.stop <= len(self._owner) and (self._owner[rows] == number).all()
        if row["episode_index"] != number or not whole or not tasks <= set(self._tasks):
            raise ValueError(f"{self._folder}: the metadata of episode {number} contradicts the data: {REMEDY}")
        if len(tasks) > 1:
            raise ValueError(f"{self._folder} has several tasks in episode {number}: only one is supported")
        return rows, self._tasks[tasks.pop()]

    def _read_info(self) -> layout.Info:
        path = self._folder / "meta/info.json"
        if not path.exists():
            raise ValueError(f"there is no LeRobot dataset in {self._folder} (no meta/info.json)")
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
        path = self._folder / layout.CHECKSUMS
        if not path.exists():
            return
        try:
            expected, found = read_json(path, layout.Checksums), layout.checksums(self._folder)
        except ValueError as error:
            raise ValueError(f"{error}: {REMEDY}") from error
        if changed := [name for name in expected if expected[name] != found.get(name)]:
            raise ValueError(
                f"{self._folder} has changed since it was exported, in {', '.join(changed)[:200]}: {REMEDY}, or delete "
                f"{layout.CHECKSUMS} if this was intended"
            )

    def _require_fit(self, info: layout.Info) -> None:
        found, action = list(mismatches(info, self.spec)), info.features.get(layout.ACTION)
        if action is not None and action.shape == (len(self.spec.action),):
            found += out_of_bounds(self._matrix(self._rows([layout.ACTION]), layout.ACTION), self.spec)
        if found:
            raise ValueError(f"{self._folder} is not of the task's kind of step: {'; '.join(found)}")

    def _rows(self, names: list[str]) -> pa.Table:
        return self._table("data", dict.fromkeys(names, numbers) | {"episode_index": counts, "task_index": counts})

    def _matrix(self, rows: pa.Table, name: str) -> Array:
        """Return a column of lists as (N, …) float32."""
        size = layout.features(self.spec, depth=True)[name]["shape"][0]
        values = tables.matrix(rows[name], size)
        if values is None or not len(values):
            raise ValueError(f"{self._folder}/data has rows of {name} that are not {size} finite numbers: {REMEDY}")
        return values

    def _read_episodes(self) -> list[dict[str, Any]]:
        """Return the rows of `meta/episodes`, in the order of the episodes."""
        names = ("episode_index", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")
        columns = dict.fromkeys(names, counts)
        for video in (f"videos/{layout.image_key(camera)}" for camera in self._videos):
            columns |= {f"{video}/chunk_index": counts, f"{video}/file_index": counts}
            columns |= {f"{video}/from_timestamp": tables.times}
        found: list[dict[str, Any]] = self._table("meta/episodes", columns).sort_by("episode_index").to_pylist()
        return found

    def _read_tasks(self) -> dict[int, str]:
        """Return index → instruction; the name of the column of instructions depends on the writer."""
        path = self._folder / layout.TASKS
        columns = tables.columns_of(path)
        names = [name for name in columns if name != "task_index"]
        if len(names) != 1:
            raise ValueError(f"{path} has the columns {', '.join(columns)[:200]}, not one of tasks and task_index")
        table = tables.read([path], {"task_index": counts, names[0]: tables.texts})
        found = dict(zip(table["task_index"].to_pylist(), table[names[0]].to_pylist(), strict=True))
        if longer := [index for index, text in found.items() if len(text) > LONGEST_INSTRUCTION]:
            raise ValueError(f"{path} has tasks of more than {LONGEST_INSTRUCTION} characters: {listed(longer)}")
        return found

    def _table(self, name: str, columns: Mapping[str, tables.Kind]) -> pa.Table:
        paths = sorted((self._folder / name).glob("chunk-*/file-*.parquet"))
        if not paths:
            raise ValueError(f"{self._folder / name} holds no tables: {REMEDY}")
        return tables.read(paths, columns)
