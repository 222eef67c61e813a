"""Layout of a LeRobot dataset, version 3.0: file names, features and metadata.

    meta/info.json                            features, sizes and rate
    meta/stats.json                           moments and quantiles of every feature
    meta/tasks.parquet                        instruction → task_index
    meta/episodes/chunk-000/file-000.parquet  range and statistics of every episode
    data/chunk-000/file-000.parquet           one row per step
    videos/observation.images.CAMERA/chunk-000/file-000.mp4     several episodes in sequence
    meta/checksums.json                       file → CRC-32; only `vla` writes it

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from annotated_types import Ge, MaxLen

from vla.data.formats.video import PIXELS
from vla.io.documents import LENIENT
from vla.io.types import Count, Natural, Positive
from vla.spec import Array, Spec

VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{FILE}.parquet"
VIDEOS = f"videos/{{video_key}}/{FILE}.mp4"
EPISODES = f"meta/episodes/{FILE}.parquet"
TASKS = "meta/tasks.parquet"
CHECKSUMS = "meta/checksums.json"
FILES_PER_CHUNK = 1000
CHANNELS = (1, 3, 4)  # of images: grey, colours, colours and transparency
RATE_TOLERANCE = 0.01  # relative; cameras of 29.97 Hz are said to have 30

# LeRobot's policies use every feature "observation…" as an input, every "action…" as an output, and every image as a
# colour image: other features have other names, and depth is an array.
STATE, ACTION, EXECUTED, RATES = "observation.state", "action", "executed", "velocities"
COUNTERS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64"}
COUNTERS |= {"index": "int64", "task_index": "int64"}


@dataclass
class Feature:
    """Description of a column or a video in `info.json`."""

    __pydantic_config__ = LENIENT

    dtype: str
    shape: Annotated[tuple[Count, ...], MaxLen(8)]
    names: Any = None
    info: Any = None  # of a video
    video_info: Any = None  # the same in older datasets

    @property
    def components(self) -> list[str] | None:
        """Names from a list, lists within a dictionary, one after the other, or a dictionary of indices.

        None if unknown. Where several lists share a name, names begin with the key of their list.
        """
        names = self.names
        if isinstance(names, dict) and all(isinstance(index, int) for index in names.values()):
            names = sorted(names, key=names.__getitem__)
        elif isinstance(names, dict) and all(isinstance(part, list) for part in names.values()):
            parts = [(key, name) for key, part in names.items() for name in part]
            apart = len({str(name) for _, name in parts}) == len(parts)
            names = [name if apart or not isinstance(name, str) else f"{key}_{name}" for key, name in parts]
        known = isinstance(names, list) and all(isinstance(name, str) for name in names)
        return names if names and known and [len(names)] == list(self.shape) else None

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width [px], for channels first or last."""
        first = len(self.shape) == 3 and self.shape[0] in CHANNELS and self.shape[-1] not in CHANNELS
        height, width = (*self.shape[1:], 1, 1)[:2] if first else (*self.shape, 1, 1)[:2]
        return height, width

    @property
    def is_depth(self) -> bool:
        """True if the images are depth."""
        told = [part for part in (self.info, self.video_info) if isinstance(part, dict)]
        return any(True in (part.get("is_depth_map"), part.get("video.is_depth_map")) for part in told)


@dataclass
class Info:
    """Keys of `info.json` that an import uses."""

    __pydantic_config__ = LENIENT

    fps: Positive
    features: dict[str, Feature]
    total_episodes: Natural = 0  # those of a part of a dataset are larger than what it holds
    total_frames: Natural = 0


Checksums = dict[str, Annotated[int, Ge(0)]]  # path in the dataset → CRC-32


def checksums(folder: Path) -> Checksums:
    """Compute the checksums of all files of a dataset but `CHECKSUMS`."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / CHECKSUMS)
    return {path.relative_to(folder).as_posix(): _crc(path) for path in files}


def _crc(path: Path) -> int:
    crc = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            crc = zlib.crc32(block, crc)
    return crc


def image_key(camera: str) -> str:
    """Return the feature name of the colour images of a camera."""
    return f"observation.images.{camera}"


def depth_key(camera: str) -> str:
    """Return the feature name of the depth of a camera."""
    return f"depth.{camera}"


def place(pattern: str, file: int = 0, **names: str) -> str:
    """Return the path of file number `file` of a pattern."""
    chunk, file = divmod(file, FILES_PER_CHUNK)
    return pattern.format(chunk_index=chunk, file_index=file, **names)


def fraction(hz: float) -> Fraction:
    """Return steps per second as a fraction, the frame rate of videos."""
    return Fraction(hz).limit_denominator(1000)


def features(spec: Spec, depth: bool) -> dict[str, dict[str, Any]]:
    """Return the features in `info.json` for a spec, optionally with columns of depth."""
    names = {STATE: [spec.state[index] for index in spec.pose], ACTION: [*spec.action], EXECUTED: [*spec.action]}
    if spec.rates:
        names[RATES] = [spec.state[index] for index in spec.rates]
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
    found |= {image_key(camera): image for camera in spec.cameras}
    if depth:
        pixels = {"dtype": "uint16", "shape": [height, width], "names": ["height", "width"]}
        found |= {depth_key(camera): pixels for camera in spec.depth}
    return found | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in COUNTERS.items()}


def info(spec: Spec, depth: bool, episodes: int, frames: int, tasks: int) -> dict[str, Any]:
    """Return the content of `info.json`."""
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": _fps(spec),
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": VIDEOS,
        "features": features(spec, depth),
    }


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the table of tasks with pandas metadata that make the task its index, as LeRobot expects."""
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
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path, write_page_checksum=True)


def write_rows(path: Path, episodes: Iterable[dict[str, Array]]) -> None:
    """Write columns, each (N,), (N, D) or (N, H, W), with a row group per episode.

    The schema metadata has the types that the package `datasets` needs.
    """
    writer: pq.ParquetWriter | None = None
    metadata: dict[str, str] = {}
    try:
        for columns in episodes:
            table = pa.table({name: _arrow(values) for name, values in columns.items()})
            if writer is None:
                kinds = {name: _kind(values) for name, values in columns.items()}
                metadata = {"huggingface": json.dumps({"info": {"features": kinds}})}
                schema = table.schema.with_metadata(metadata)
                writer = pq.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True)
            writer.write_table(table.replace_schema_metadata(metadata))
    finally:
        if writer is not None:
            writer.close()


def _kind(values: Array) -> dict[str, Any]:
    value = {"dtype": values.dtype.name, "_type": "Value"}
    if values.ndim == 1:
        return value
    if values.ndim == 2:
        return {"feature": value, "length": values.shape[1], "_type": "List"}
    return {"dtype": values.dtype.name, "shape": values.shape[1:], "_type": "Array2D"}


def _arrow(values: Array) -> pa.Array:
    flat = pa.array(values.ravel())
    if values.ndim == 1:
        return flat
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    for size in (values.shape[2], values.shape[1]):
        flat = pa.ListArray.from_arrays(pa.array(np.arange(0, len(flat) + 1, size, dtype=np.int32)), flat)
    return flat


def _fps(spec: Spec) -> float | int:
    return int(spec.control_hz) if float(spec.control_hz).is_integer() else spec.control_hz
