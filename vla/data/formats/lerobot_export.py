"""Export to a LeRobot dataset, without the package `lerobot`.

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from annotated_types import Ge, Le

from vla.data.episodes import EpisodeStore
from vla.data.formats import lerobot_layout as layout
from vla.data.formats.files import UNFINISHED, map_episodes, provenance, staging_folder
from vla.data.formats.lerobot_images import encode
from vla.data.formats.lerobot_tables import write_rows, write_tasks
from vla.io.documents import read_json
from vla.io.errors import UserError
from vla.io.files import write_json
from vla.io.types import Text
from vla.parallel.pool import THIS_PROCESS, Cluster
from vla.spec import Array

log = logging.getLogger(__name__)

# Compromise: readers keep every file open, and find frames by 32-bit seconds, which are inexact in long files.
EPISODES_PER_VIDEO = 50

MAX_SOURCE_BYTES = 1 << 30  # of `meta/vla.json`, which contains the draws of every episode
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Columns = dict[str, Array]
Statistics = dict[str, Any]


class LeRobotExporter:
    """Export to a dataset that `lerobot` and the Rerun viewer open: videos, state, action to imitate.

    The instruction is the task; rates of change of the state and the executed action are further features.
    `meta/vla.json` contains the provenance of the episodes.

    Args:
        folder: of the dataset; created when it is complete.
        crf: quality of the videos, from 0 (best) to 63.
    """

    def __init__(self, folder: Text | Path, crf: Annotated[int, Ge(0), Le(63)]) -> None:
        self._folder, self._crf = Path(folder).resolve(), crf

    def export(self, store: EpisodeStore, cluster: Cluster = THIS_PROCESS) -> Path:
        """Write the dataset, or resume an interrupted export; returns the folder (UserError: the folder has other
        content, or the store is damaged or empty)."""
        store.require_episodes()
        episodes = [provenance(entry) for entry in store.episodes]
        source = {"spec": store.spec.to_dict(), "crf": self._crf, "episodes": episodes}
        if self._folder.is_mount() and not _is_complete(self._folder, source):  # which no other folder can replace
            raise UserError(f"{self._folder} is where a disk is mounted: choose a new folder on it as export.folder")
        with staging_folder(self._folder, self._folder.with_name(f".{self._folder.name}{UNFINISHED}")) as staging:
            if _is_complete(self._folder, source):
                return self._folder
            if self._folder.exists() and (not self._folder.is_dir() or any(self._folder.iterdir())):
                raise UserError(f"{self._folder} has content other than these episodes: choose another export.folder")
            if store.codec.images == "jpeg":
                log.warning("videos lose more of the JPEG images in %s: export=files loses nothing", store.folder)
            draft = staging / "dataset"
            if not _has_source(draft, source):
                shutil.rmtree(draft, ignore_errors=True)
                write_json(draft / "meta/vla.json", source)
            for leftover in draft.rglob(".*"):  # what a killed process was writing
                leftover.unlink()
            self._write(draft, store, cluster)
            os.rename(draft, self._folder)
        return self._folder

    def _write(self, draft: Path, store: EpisodeStore, cluster: Cluster) -> None:
        files = range(-(-len(store.episodes) // EPISODES_PER_VIDEO))
        units = [(camera, file) for camera in store.spec.cameras for file in files]
        histograms: dict[str, list[Array]] = {camera: [] for camera in store.spec.cameras}
        work = partial(self._write_video, draft)
        for (camera, _), counts in zip(units, map_episodes(work, store, units, cluster), strict=True):
            histograms[camera] += counts
        tasks = [*dict.fromkeys(entry.instruction for entry in store.episodes)]
        episode_columns = list(_columns(store, tasks))
        episodes = [_episode(store, number, columns, histograms) for number, columns in enumerate(episode_columns)]
        dataset = {name: np.concatenate([columns[name] for columns in episode_columns]) for name in episode_columns[0]}
        statistics = {name: _moments(values) for name, values in dataset.items()}
        for camera, counts in histograms.items():
            statistics[layout.IMAGES + camera] = _image_moments(np.sum(counts, 0), len(dataset["index"]))
        write_rows(_ensure_parent(draft / layout.place(layout.DATA)), episode_columns)
        table = pa.Table.from_pylist(episodes)
        pq.write_table(table, _ensure_parent(draft / layout.place(layout.EPISODES)), write_page_checksum=True)
        write_tasks(draft / layout.TASKS, tasks)
        write_json(draft / "meta/stats.json", statistics)
        info = layout.info(store.spec, len(episodes), len(dataset["index"]), len(tasks))
        write_json(draft / "meta/info.json", info)
        write_json(draft / layout.CHECKSUMS, layout.checksums(draft))

    def _write_video(self, draft: Path, store: EpisodeStore, unit: tuple[str, int]) -> list[Array]:
        """Write one file of a camera unless it exists; returns histograms of colour values, (3, 256) per episode."""
        camera, file = unit
        histograms: list[Array] = []
        # Files of the first camera also verify what is not exported; those of the others need not read it again.
        fields = None if camera == store.spec.cameras[0] else [f"rgb_{camera}"]

        def clips() -> Iterator[Array]:
            for entry in store.episodes[file * EPISODES_PER_VIDEO :][:EPISODES_PER_VIDEO]:
                images = store.read(entry, fields)[f"rgb_{camera}"]
                colours = (images[..., colour].ravel() for colour in range(3))
                histograms.append(np.stack([np.bincount(values, minlength=256) for values in colours]))
                yield images

        path = _ensure_parent(draft / layout.place(layout.VIDEOS, file, video_key=layout.IMAGES + camera))
        if path.exists():
            deque(clips(), 0)  # the histograms are needed in any case
        else:
            draft_file, fps = path.with_suffix(".draft"), layout.fraction(store.spec.control_hz)
            encode(draft_file, clips(), store.spec.image_size, fps, self._crf)
            os.replace(draft_file, path)
        return histograms


def _is_complete(folder: Path, source: Mapping[str, Any]) -> bool:
    """Return whether a folder has the whole dataset of these episodes."""
    try:
        files = read_json(folder / layout.CHECKSUMS, layout.Checksums)
    except (OSError, ValueError):  # missing or incomplete
        return False
    return all((folder / name).is_file() for name in files) and _has_source(folder, source)


def _has_source(folder: Path, source: Mapping[str, Any]) -> bool:
    """Return whether a folder was begun from the same episodes, with the same options."""
    try:
        return read_json(folder / "meta/vla.json", dict[str, Any], MAX_SOURCE_BYTES) == source
    except (OSError, ValueError):
        return False


def _ensure_parent(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _columns(store: EpisodeStore, tasks: list[str]) -> Iterator[Columns]:
    """Yield the columns of the `data/` table of every episode."""
    fields = {name: store.rows(name) for name in ("state", "action", "executed")}
    index = 0
    for number, entry in enumerate(store.episodes):
        rows = {name: np.array(values[entry.span]) for name, values in fields.items()}
        frames = np.arange(entry.steps)
        yield {
            layout.STATE: rows["state"][:, store.spec.pose],
            layout.ACTION: rows["action"],
            layout.EXECUTED: rows["executed"],
            **({layout.RATES: rows["state"][:, store.spec.rates]} if store.spec.rates else {}),
            "timestamp": (frames / store.spec.control_hz).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full_like(frames, number),
            "index": frames + index,
            "task_index": np.full_like(frames, tasks.index(entry.instruction)),
        }
        index += entry.steps


def _episode(
    store: EpisodeStore, number: int, columns: Columns, histograms: Mapping[str, list[Array]]
) -> dict[str, Any]:
    """Return the row of an episode in `meta/episodes/`."""
    entries, fps = store.episodes, layout.fraction(store.spec.control_hz)
    file, place = divmod(number, EPISODES_PER_VIDEO)
    offset = sum(entry.steps for entry in entries[number - place : number])  # in the same video
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
    chunk, file = divmod(file, layout.FILES_PER_CHUNK)
    statistics = {name: _moments(values) for name, values in columns.items()}
    for camera, counts in histograms.items():
        video = f"videos/{layout.IMAGES}{camera}"
        row |= {f"{video}/chunk_index": chunk, f"{video}/file_index": file}
        row |= {f"{video}/from_timestamp": float(offset / fps), f"{video}/to_timestamp": float((offset + steps) / fps)}
        statistics[layout.IMAGES + camera] = _image_moments(counts[number], steps)
    return row | {f"stats/{key}/{name}": value for key, values in statistics.items() for name, value in values.items()}


def _moments(values: Array) -> Statistics:
    """Compute moments and quantiles of (N,) or (N, D) values over the steps, one number per component."""
    values = values.reshape(len(values), -1).astype(np.float64)
    moments = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    moments |= zip(QUANTILES, np.quantile(values, [*QUANTILES.values()], axis=0), strict=True)
    return {name: value.tolist() for name, value in moments.items()} | {"count": [len(values)]}


def _image_moments(counts: Array, images: int) -> Statistics:
    """Compute the same statistics of images in 0…1 from their histograms, `counts` (3, 256); each (3, 1, 1)."""
    levels, total = np.arange(256) / 255, counts.sum(1)
    mean = counts @ levels / total
    distribution = counts.cumsum(1) / total[:, None]
    moments = {
        "min": levels[(counts > 0).argmax(1)],
        "max": levels[255 - (counts[:, ::-1] > 0).argmax(1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
        **{name: levels[(distribution >= share).argmax(1)] for name, share in QUANTILES.items()},
    }
    return {name: value.reshape(3, 1, 1).tolist() for name, value in moments.items()} | {"count": [images]}
