"""Demonstrations as a LeRobot dataset, version 3.0 of its layout, without the package `lerobot`.

    meta/info.json                            features, sizes and rate
    meta/stats.json                           moments and quantiles of every feature
    meta/tasks.parquet                        instruction → task_index
    meta/episodes/chunk-000/file-000.parquet  where every episode begins and ends, and its own statistics
    meta/vla.json                             how the episodes came about
    data/chunk-000/file-000.parquet           one row per step
    videos/observation.images.CAMERA/chunk-000/file-000.mp4     several episodes, one after the other

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import deque
from collections.abc import Iterator, Mapping
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vla.data.episodes import EpisodeStore
from vla.data.export import each, origin, unfinished, write_json
from vla.data.moments import image_moments, moments
from vla.data.video import PIXELS, encode
from vla.spec import Array, Spec

VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{FILE}.parquet"
VIDEOS = f"videos/{{video_key}}/{FILE}.mp4"
EPISODES = f"meta/episodes/{FILE}.parquet"
FILES_PER_CHUNK = 1000

# Readers keep a video open and look frames up by 32-bit seconds: neither one file per episode nor a single one will do.
EPISODES_PER_VIDEO = 50

# What policies of LeRobot read is called "observation…" and "action…"; what else there is has other names, so that
# they do not take it for an input or an output.
STATE, ACTION, EXECUTED, VELOCITIES = "observation.state", "action", "executed", "velocities"
COUNTERS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64"}
COUNTERS |= {"index": "int64", "task_index": "int64"}

Columns = dict[str, Array]


class LeRobot:
    """A folder that `lerobot` and the Rerun viewer open: videos, joint positions and gripper, the action to imitate.

    The instruction is the task; joint velocities and the executed action are further features. Depth is left out: the
    layout has no place for it that policies would not take for a colour image.

    Args:
        folder: where to write; it appears when all of it is there.
        crf: quality of the videos, from 0, the best, to 63.
        workers: processes; null: one per core. The files do not depend on it.
    """

    def __init__(
        self, folder: str | Path, crf: Annotated[int, 0] = 30, workers: Annotated[int, 1] | None = None
    ) -> None:
        if crf > 63:
            raise ValueError(f"export.crf is from 0 to 63, not {crf}")
        self._folder, self._crf, self._workers = Path(folder).resolve(), crf, workers

    def export(self, store: EpisodeStore) -> Path:
        """Write the dataset, or what an export that was cut short left to do; returns the folder.

        Raises:
            ValueError: the folder holds something else, or the store is damaged or empty.
        """
        source = self._source(store)
        if not source["episodes"]:
            raise ValueError(f"{store.folder} holds no episodes yet: collect some first")
        if _is_of(self._folder, source):
            return self._folder
        if self._folder.exists() and (not self._folder.is_dir() or any(self._folder.iterdir())):
            raise ValueError(f"{self._folder} holds something else than these episodes: choose another export.folder")
        with unfinished(self._folder) as place:
            draft = place / "dataset"
            if not _is_of(draft, source):
                shutil.rmtree(draft, ignore_errors=True)
                (draft / "meta").mkdir(parents=True)
                write_json(draft / "meta/vla.json", source)
            self._write(draft, store)
            os.rename(draft, self._folder)
        return self._folder

    def _source(self, store: EpisodeStore) -> dict[str, Any]:
        episodes = [origin(entry) for entry in store.episodes]
        return {"spec": store.spec.to_dict(), "crf": self._crf, "episodes": episodes}

    def _write(self, draft: Path, store: EpisodeStore) -> None:
        files = range(-(-len(store.episodes) // EPISODES_PER_VIDEO))
        units = [(camera, file) for camera in store.spec.cameras for file in files]
        counts: dict[str, list[Array]] = {camera: [] for camera in store.spec.cameras}
        work = partial(self._write_video, draft)
        for (camera, _), found in zip(units, each(work, store, units, self._workers), strict=True):
            counts[camera] += found
        columns = list(_columns(store))
        episodes = [_episode(store, number, columns[number], counts) for number in range(len(columns))]
        whole = {name: np.concatenate([one[name] for one in columns]) for name in columns[0]}
        statistics = {name: moments(values) for name, values in whole.items()}
        statistics |= {_key(camera): image_moments(np.sum(found, 0)) for camera, found in counts.items()}
        _write_rows(_made(draft / _at(DATA)), columns)
        pq.write_table(pa.Table.from_pylist(episodes), _made(draft / _at(EPISODES)))
        _write_tasks(draft / "meta/tasks.parquet", list(_tasks(store)))
        write_json(draft / "meta/stats.json", statistics)
        write_json(draft / "meta/info.json", _info(store))

    def _write_video(self, draft: Path, store: EpisodeStore, unit: tuple[str, int]) -> list[Array]:
        """Write one file of a camera, if it is not there; how often each value occurs, (3, 256) per episode."""
        camera, file = unit
        counts: list[Array] = []

        def clips() -> Iterator[Array]:
            for entry in store.episodes[file * EPISODES_PER_VIDEO :][:EPISODES_PER_VIDEO]:
                seen = store.read(entry)[f"rgb_{camera}"]
                counts.append(np.stack([np.bincount(seen[..., colour].ravel(), minlength=256) for colour in range(3)]))
                yield seen

        path = _made(draft / _at(VIDEOS, file, video_key=_key(camera)))
        if path.exists():
            deque(clips(), 0)  # counted all the same
        else:
            encode(path.with_suffix(".draft"), clips(), store.spec.image_size, rate(store.spec), self._crf)
            os.replace(path.with_suffix(".draft"), path)
        return counts


def rate(spec: Spec) -> Fraction:
    """Steps per second, as videos count."""
    return Fraction(spec.control_hz).limit_denominator(1000)


def features(spec: Spec) -> dict[str, dict[str, Any]]:
    """What `info.json` says about the columns and videos of a spec."""
    names = {
        STATE: [*spec.joints, "gripper"],
        ACTION: [*spec.action],
        EXECUTED: [*spec.action],
        VELOCITIES: [*spec.joints],
    }
    found: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": [len(of)], "names": of} for name, of in names.items()
    }
    height, width = spec.image_size
    video = {
        "video.height": height,
        "video.width": width,
        "video.channels": 3,
        "video.codec": "av1",
        "video.pix_fmt": PIXELS,
        "video.is_depth_map": False,
        "video.fps": _fps(spec),
        "has_audio": False,
    }
    image = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": video}
    found |= {_key(camera): image for camera in spec.cameras}
    return found | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in COUNTERS.items()}


def _is_of(folder: Path, source: Mapping[str, Any]) -> bool:
    path = folder / "meta/vla.json"
    try:
        return bool(json.loads(path.read_text(encoding="utf-8")) == source)
    except (OSError, ValueError):  # not there, or cut short
        return False


def _key(camera: str) -> str:
    return f"observation.images.{camera}"


def _at(pattern: str, file: int = 0, **names: str) -> str:
    chunk, file = divmod(file, FILES_PER_CHUNK)
    return pattern.format(chunk_index=chunk, file_index=file, **names)


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _fps(spec: Spec) -> float | int:
    return int(spec.control_hz) if spec.control_hz.is_integer() else spec.control_hz


def _tasks(store: EpisodeStore) -> dict[str, int]:
    """Instruction → index, in the order of their first appearance."""
    return {task: index for index, task in enumerate(dict.fromkeys(entry.instruction for entry in store.episodes))}


def _columns(store: EpisodeStore) -> Iterator[Columns]:
    """The rows of `data/` of every episode."""
    fields = {name: store.rows(name) for name in ("joints", "gripper", "velocities", "action", "executed")}
    tasks, index = _tasks(store), 0
    for number, entry in enumerate(store.episodes):
        rows = {name: values[entry.start : entry.start + entry.steps] for name, values in fields.items()}
        frames = np.arange(entry.steps)
        yield {
            STATE: np.concatenate([rows["joints"], rows["gripper"]], 1),
            ACTION: np.array(rows["action"]),
            EXECUTED: np.array(rows["executed"]),
            VELOCITIES: np.array(rows["velocities"]),
            "timestamp": (frames / store.spec.control_hz).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full_like(frames, number),
            "index": frames + index,
            "task_index": np.full_like(frames, tasks[entry.instruction]),
        }
        index += entry.steps


def _episode(store: EpisodeStore, number: int, columns: Columns, counts: Mapping[str, list[Array]]) -> dict[str, Any]:
    """The row of `meta/episodes/` of an episode."""
    entries = store.episodes
    file, place = divmod(number, EPISODES_PER_VIDEO)
    before = sum(entry.steps for entry in entries[number - place : number])  # in the same video
    begin, steps = int(columns["index"][0]), entries[number].steps
    row: dict[str, Any] = {
        "episode_index": number,
        "tasks": [entries[number].instruction],
        "length": steps,
        "dataset_from_index": begin,
        "dataset_to_index": begin + steps,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    chunk, file = divmod(file, FILES_PER_CHUNK)
    statistics = {name: moments(values) for name, values in columns.items()}
    for camera, found in counts.items():
        video = f"videos/{_key(camera)}"
        row |= {f"{video}/chunk_index": chunk, f"{video}/file_index": file}
        row |= {f"{video}/from_timestamp": float(before / rate(store.spec))}
        row |= {f"{video}/to_timestamp": float((before + steps) / rate(store.spec))}
        statistics[_key(camera)] = image_moments(found[number])
    return row | {f"stats/{key}/{name}": value for key, of in statistics.items() for name, value in of.items()}


def _write_rows(path: Path, episodes: list[Columns]) -> None:
    """A row group per episode, with the types that the package `datasets` expects in the metadata."""
    kinds: dict[str, Any] = {}
    for name, values in episodes[0].items():
        kind = {"dtype": values.dtype.name, "_type": "Value"}
        kinds[name] = {"feature": kind, "length": values.shape[1], "_type": "List"} if values.ndim == 2 else kind
    metadata = {"huggingface": json.dumps({"info": {"features": kinds}})}
    tables = [pa.table({name: _arrow(values) for name, values in columns.items()}) for columns in episodes]
    with pq.ParquetWriter(path, tables[0].schema.with_metadata(metadata)) as writer:
        for table in tables:
            writer.write_table(table.replace_schema_metadata(metadata))


def _arrow(values: Array) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _write_tasks(path: Path, tasks: list[str]) -> None:
    """The table that pandas reads as indexed by the task, which is how LeRobot looks them up."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    names = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, (kind, numpy) in names.items()
    ]
    index = {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [index | {"metadata": {"encoding": "UTF-8"}}],
        "columns": columns,
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _info(store: EpisodeStore) -> dict[str, Any]:
    episodes = len(store.episodes)
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": episodes,
        "total_frames": sum(entry.steps for entry in store.episodes),
        "total_tasks": len(_tasks(store)),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": _fps(store.spec),
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": VIDEOS,
        "features": features(store.spec),
    }
