"""Export to a LeRobot dataset, without the package `lerobot`.

Shapes: N steps, D components, H by W pixels.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from annotated_types import Ge, Le

from vla.data.episodes import EpisodeStore
from vla.data.formats import lerobot_layout as layout
from vla.data.formats.files import map_episodes, provenance, require_empty, staging_folder, write_json
from vla.data.formats.lerobot_statistics import image_moments, moments
from vla.data.formats.video import encode
from vla.io.documents import read_json
from vla.io.types import Text
from vla.parallel.pool import THIS_PROCESS, Cluster
from vla.spec import Array

log = logging.getLogger(__name__)

# Compromise: readers keep every file open, and find frames by 32-bit seconds, which are inexact in long files.
EPISODES_PER_VIDEO = 50

MAX_BYTES = 1 << 30  # [bytes] of `meta/vla.json`, which contains the draws of every episode

Columns = dict[str, Array]


class LeRobotExporter:
    """Export to a dataset that `lerobot` and the Rerun viewer open: videos, state, action to imitate.

    The instruction is the task; rates of change of the state and the executed action are further features.
    `meta/vla.json` contains the provenance of the episodes.

    Args:
        folder: of the dataset; created when it is complete.
        crf: quality of the videos, from 0 (best) to 63.
        depth: add depth as arrays [mm], 0: no return; reading a step then takes several times as long.
    """

    def __init__(self, folder: Text | Path, crf: Annotated[int, Ge(0), Le(63)], depth: bool) -> None:
        self._folder = Path(folder).resolve()
        self._crf, self._depth = crf, depth

    def export(self, store: EpisodeStore, cluster: Cluster = THIS_PROCESS) -> Path:
        """Write the dataset, or resume an interrupted export; returns the folder.

        Raises:
            UserError: the folder has other content, or the store is damaged or empty.
        """
        store.require_episodes()
        source = self._source(store)
        with staging_folder(self._folder) as place:
            if _holds(self._folder, source):
                return self._folder
            require_empty(self._folder)
            if store.codec.images == "jpeg":
                log.warning("%s holds JPEG, of which videos lose more: export=files loses nothing", store.folder)
            draft = place / "dataset"
            if not _holds(draft, source):
                shutil.rmtree(draft, ignore_errors=True)
                (draft / "meta").mkdir(parents=True)
                write_json(draft / "meta/vla.json", source)
            self._write(draft, store, cluster)
            os.rename(draft, self._folder)
        return self._folder

    def _source(self, store: EpisodeStore) -> dict[str, Any]:
        episodes = [provenance(entry) for entry in store.episodes]
        return {"spec": store.spec.to_dict(), "crf": self._crf, "depth": self._depth, "episodes": episodes}

    def _write(self, draft: Path, store: EpisodeStore, cluster: Cluster) -> None:
        files = range(-(-len(store.episodes) // EPISODES_PER_VIDEO))
        units = [(camera, file) for camera in store.spec.cameras for file in files]
        counts: dict[str, list[Array]] = {camera: [] for camera in store.spec.cameras}
        work = partial(self._write_video, draft)
        for (camera, _), found in zip(units, map_episodes(work, store, units, cluster), strict=True):
            counts[camera] += found
        columns, tasks = list(_columns(store)), list(_tasks(store))
        episodes = [_episode(store, number, one, counts) for number, one in enumerate(columns)]
        whole = {name: np.concatenate([one[name] for one in columns]) for name in columns[0]}
        statistics = {name: moments(values) for name, values in whole.items()}
        for camera, found in counts.items():
            statistics[layout.image_key(camera)] = image_moments(np.sum(found, 0), len(whole["index"]))
        layout.write_rows(_made(draft / layout.place(layout.DATA)), self._rows(store, columns))
        table = pa.Table.from_pylist(episodes)
        pq.write_table(table, _made(draft / layout.place(layout.EPISODES)), write_page_checksum=True)
        layout.write_tasks(draft / layout.TASKS, tasks)
        write_json(draft / "meta/stats.json", statistics)
        info = layout.info(store.spec, self._depth, len(episodes), len(whole["index"]), len(tasks))
        write_json(draft / "meta/info.json", info)
        write_json(draft / layout.CHECKSUMS, layout.checksums(draft))

    def _rows(self, store: EpisodeStore, columns: Sequence[Columns]) -> Iterator[Columns]:
        """Yield the columns of every episode, with depth if requested."""
        depths = {camera: store.rows(f"depth_{camera}") for camera in store.spec.depth if self._depth}
        for entry, numbers in zip(store.episodes, columns, strict=True):
            yield numbers | {layout.depth_key(camera): values[entry.span] for camera, values in depths.items()}

    def _write_video(self, draft: Path, store: EpisodeStore, unit: tuple[str, int]) -> list[Array]:
        """Write one file of a camera unless it exists; returns histograms of colour values, (3, 256) per episode."""
        camera, file = unit
        counts: list[Array] = []

        def clips() -> Iterator[Array]:
            for entry in store.episodes[file * EPISODES_PER_VIDEO :][:EPISODES_PER_VIDEO]:
                images = store.read(entry)[f"rgb_{camera}"]
                counts.append(
                    np.stack([np.bincount(images[..., colour].ravel(), minlength=256) for colour in range(3)])
                )
                yield images

        path = _made(draft / layout.place(layout.VIDEOS, file, video_key=layout.image_key(camera)))
        if path.exists():
            deque(clips(), 0)  # the histograms are needed in any case
        else:
            encode(
                path.with_suffix(".draft"),
                clips(),
                store.spec.image_size,
                layout.fraction(store.spec.control_hz),
                self._crf,
            )
            os.replace(path.with_suffix(".draft"), path)
        return counts


def _holds(folder: Path, source: Mapping[str, Any]) -> bool:
    path = folder / "meta/vla.json"
    try:
        return read_json(path, dict[str, Any], MAX_BYTES) == source
    except (OSError, ValueError):  # missing or incomplete
        return False


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _tasks(store: EpisodeStore) -> dict[str, int]:
    """Return instruction → index, in the order of first occurrence."""
    return {task: index for index, task in enumerate(dict.fromkeys(entry.instruction for entry in store.episodes))}


def _columns(store: EpisodeStore) -> Iterator[Columns]:
    """Yield the columns of the `data/` table of every episode."""
    fields = {name: store.rows(name) for name in ("state", "action", "executed")}
    tasks, index = _tasks(store), 0
    for number, entry in enumerate(store.episodes):
        rows = {name: values[entry.span] for name, values in fields.items()}
        frames = np.arange(entry.steps)
        rates = {layout.RATES: np.array(rows["state"][:, store.spec.rates])} if store.spec.rates else {}
        yield {
            layout.STATE: np.array(rows["state"][:, store.spec.pose]),
            layout.ACTION: np.array(rows["action"]),
            layout.EXECUTED: np.array(rows["executed"]),
            **rates,
            "timestamp": (frames / store.spec.control_hz).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full_like(frames, number),
            "index": frames + index,
            "task_index": np.full_like(frames, tasks[entry.instruction]),
        }
        index += entry.steps


def _episode(store: EpisodeStore, number: int, columns: Columns, counts: Mapping[str, list[Array]]) -> dict[str, Any]:
    """Return the row of an episode in `meta/episodes/`."""
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
    chunk, file = divmod(file, layout.FILES_PER_CHUNK)
    statistics = {name: moments(values) for name, values in columns.items()}
    for camera, found in counts.items():
        video = f"videos/{layout.image_key(camera)}"
        row |= {f"{video}/chunk_index": chunk, f"{video}/file_index": file}
        row |= {f"{video}/from_timestamp": float(before / layout.fraction(store.spec.control_hz))}
        row |= {f"{video}/to_timestamp": float((before + steps) / layout.fraction(store.spec.control_hz))}
        statistics[layout.image_key(camera)] = image_moments(found[number], steps)
    return row | {f"stats/{key}/{name}": value for key, of in statistics.items() for name, value in of.items()}
