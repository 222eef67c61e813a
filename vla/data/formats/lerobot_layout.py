"""Layout of a LeRobot dataset, version 3.0: file names, features and metadata.

meta/info.json                            features, sizes and rate
meta/stats.json                           moments and quantiles of every feature
meta/tasks.parquet                        instruction → task_index
meta/episodes/chunk-000/file-000.parquet  range and statistics of every episode
data/chunk-000/file-000.parquet           one row per step
videos/observation.images.CAMERA/chunk-000/file-000.mp4     several episodes in sequence
meta/checksums.json                       file → CRC-32; only `vla` writes it
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, MaxLen

from vla.data.formats.lerobot_images import PIXELS
from vla.io.documents import LENIENT
from vla.io.types import Count, Natural, Positive
from vla.spec import Spec

VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{FILE}.parquet"
VIDEOS = f"videos/{{video_key}}/{FILE}.mp4"
EPISODES = f"meta/episodes/{FILE}.parquet"
TASKS = "meta/tasks.parquet"
CHECKSUMS = "meta/checksums.json"
FILES_PER_CHUNK = 1000
CHANNELS = (1, 3, 4)  # of images: grey, colours, colours and transparency
RATE_TOLERANCE = 0.01  # relative; datasets state 30 Hz for cameras of 29.97 Hz

# LeRobot's policies use every feature "observation…" as an input, every "action…" as an output, and every image as a
# colour image: other features have other names.
STATE, ACTION, EXECUTED, RATES = "observation.state", "action", "executed", "velocities"
IMAGES = "observation.images."  # and the name of a camera
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
    def components(self) -> list[str]:
        """Names from a list, lists within a dictionary, one after the other, or a dictionary of indices.

        Empty if unknown. Where several lists share a name, names begin with the key of their list.
        """
        names = self.names
        if isinstance(names, dict) and all(isinstance(index, int) for index in names.values()):
            names = sorted(names, key=names.__getitem__)
        elif isinstance(names, dict) and all(isinstance(part, list) for part in names.values()):
            parts = [(key, str(name)) for key, part in names.items() for name in part]
            distinct = len({name for _, name in parts}) == len(parts)
            names = [name if distinct else f"{key}_{name}" for key, name in parts]
        are_texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
        return names if are_texts and [len(names)] == list(self.shape) else []

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width [px], for channels first or last."""
        channels_first = len(self.shape) == 3 and self.shape[0] in CHANNELS and self.shape[-1] not in CHANNELS
        height, width, *_ = (*self.shape[1:], 1, 1) if channels_first else (*self.shape, 1, 1)
        return height, width

    @property
    def is_depth(self) -> bool:
        """True if the images are depth images."""
        descriptions = [part for part in (self.info, self.video_info) if isinstance(part, dict)]
        return any(True in (part.get("is_depth_map"), part.get("video.is_depth_map")) for part in descriptions)


@dataclass
class Info:
    """Keys of `info.json` that an import uses."""

    __pydantic_config__ = LENIENT

    fps: Positive
    features: dict[str, Feature]
    total_episodes: Natural = 0  # in a part of a dataset, totals are larger than what it holds
    total_frames: Natural = 0


Checksums = dict[str, Annotated[int, Ge(0)]]  # path in the dataset → CRC-32


def checksums(folder: Path) -> Checksums:
    """Compute the checksums of all files of a dataset but `CHECKSUMS`."""
    crcs: Checksums = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / CHECKSUMS):
        crc = 0
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                crc = zlib.crc32(block, crc)
        crcs[path.relative_to(folder).as_posix()] = crc
    return crcs


def place(pattern: str, file: int = 0, **names: str) -> str:
    """Return the path of file number `file` of a pattern."""
    chunk, file = divmod(file, FILES_PER_CHUNK)
    return pattern.format(chunk_index=chunk, file_index=file, **names)


def fraction(hz: float) -> Fraction:
    """Return steps per second as a fraction, the frame rate of videos."""
    return Fraction(hz).limit_denominator(1000)


def features(spec: Spec) -> dict[str, dict[str, Any]]:
    """Return the features in `info.json` for a spec."""
    names = {STATE: [spec.state[index] for index in spec.pose], ACTION: [*spec.action], EXECUTED: [*spec.action]}
    if spec.rates:
        names[RATES] = [spec.state[index] for index in spec.rates]
    height, width = spec.image_size
    video = {"height": height, "width": width, "channels": 3, "codec": "av1", "pix_fmt": PIXELS}
    video |= {"is_depth_map": False, "fps": _fps(spec)}
    image = _feature("video", [height, width, 3], ["height", "width", "channels"])
    image["info"] = {**{f"video.{name}": value for name, value in video.items()}, "has_audio": False}
    return {
        **{name: _feature("float32", [len(components)], components) for name, components in names.items()},
        **{IMAGES + camera: image for camera in spec.cameras},
        **{name: _feature(dtype, [1], None) for name, dtype in COUNTERS.items()},
    }


def info(spec: Spec, episodes: int, frames: int, tasks: int) -> dict[str, Any]:
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
        "features": features(spec),
    }


def _feature(dtype: str, shape: list[int], names: list[str] | None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "names": names}


def _fps(spec: Spec) -> float | int:
    return int(spec.control_hz) if float(spec.control_hz).is_integer() else spec.control_hz
