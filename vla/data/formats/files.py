"""Export of an episode store to plain files, and what all exports share."""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vla.data.episodes import EpisodeStore
from vla.data.index import Entry
from vla.io.documents import read_json
from vla.io.errors import UserError
from vla.io.files import try_lock, write_json, writing
from vla.io.printable import track
from vla.io.types import Text
from vla.parallel.pool import THIS_PROCESS, Cluster, WorkersLost

UNFINISHED = ".unfinished"  # ending of the name of a folder for incomplete files
MILLIMETRE = np.float32(0.001)  # [m]


class Files:
    """Export to a `folder` with one folder per episode and one folder of plain files per step.

        episode_00000/manifest.json                  spec and provenance of the episode
        episode_00000/step_0000/rgb_image.png        (H, W, 3) uint8
        episode_00000/step_0000/depth_image.npy      (H, W) float32 [m], 0: nothing, not even sky; for depth cameras
        episode_00000/step_0000/robot_state.json     component of the state → value
        episode_00000/step_0000/expert_action.json   the action to imitate and the executed one, each (D,)

    With several cameras the images of each are in a folder of its name: `step_0000/front/rgb_image.png`.
    """

    def __init__(self, folder: Text | Path) -> None:
        self._folder = Path(folder).resolve()

    def export(self, store: EpisodeStore, cluster: Cluster = THIS_PROCESS) -> Path:
        """Write the missing episodes, each atomically; returns the folder (UserError: the folder holds an episode of
        another store, or the store is damaged)."""
        # Within the folder, because that may be on a disk of its own.
        with staging_folder(self._folder, self._folder / UNFINISHED) as staging:
            missing_numbers = [number for number in range(len(store.episodes)) if not self._is_exported(store, number)]
            deque(map_episodes(partial(self._export, staging), store, missing_numbers, cluster), 0)
        return self._folder

    def _is_exported(self, store: EpisodeStore, number: int) -> bool:
        folder = self._folder / f"episode_{number:05d}"
        if folder.exists() and read_json(folder / "manifest.json", dict[str, Any]) != self._manifest(store, number):
            raise UserError(f"{folder} is not episode {number} of {store.folder}: choose another export.folder")
        return folder.exists()

    def _manifest(self, store: EpisodeStore, number: int) -> dict[str, Any]:
        return provenance(store.episodes[number]) | {"spec": store.spec.to_dict()}

    def _export(self, staging: Path, store: EpisodeStore, number: int) -> None:
        entry = store.episodes[number]
        draft = staging / f"episode_{number:05d}"
        shutil.rmtree(draft, ignore_errors=True)  # left by an interrupted export
        spec, rows = store.spec, store.read(entry)
        for step in range(entry.steps):
            step_folder = draft / f"step_{step:04d}"
            for camera in spec.cameras:
                image_folder = step_folder / camera if len(spec.cameras) > 1 else step_folder
                image_folder.mkdir(parents=True)
                Image.fromarray(rows[f"rgb_{camera}"][step]).save(image_folder / "rgb_image.png", compress_level=1)
                if camera in spec.depth:
                    np.save(image_folder / "depth_image.npy", rows[f"depth_{camera}"][step] * MILLIMETRE)
            state = dict(zip(spec.state, rows["state"][step].tolist(), strict=True))
            write_json(step_folder / "robot_state.json", state)
            actions = {name: rows[name][step].tolist() for name in ("action", "executed")}
            write_json(step_folder / "expert_action.json", actions)
        write_json(draft / "manifest.json", self._manifest(store, number))
        os.rename(draft, self._folder / draft.name)


def provenance(entry: Entry) -> dict[str, Any]:
    """Return an index entry as JSON values, without its place in the store."""
    fields = {**asdict(entry), "milestones": list(entry.milestones)}
    return {name: value for name, value in fields.items() if name != "start"}


@contextmanager
def staging_folder(folder: Path, staging: Path) -> Iterator[Path]:
    """Make the folder `staging` for incomplete files of an export, and remove it on success; a failure keeps it.

    Raises:
        UserError: another process is exporting to `folder`.
        OSError: the export cannot be written; the message names `folder`.
    """
    with writing(folder):
        staging.mkdir(parents=True, exist_ok=True)
    lock = try_lock(staging / "lock", f"another export to {folder} is under way: wait, or choose another export.folder")
    try:
        with writing(folder):
            yield staging
        for leftover in staging.iterdir():
            shutil.rmtree(leftover, ignore_errors=True)
    finally:
        with suppress(OSError):
            (staging / "lock").unlink()
        lock.release()
        with suppress(OSError):  # it is not empty; on NFS it would not be while the lock is held
            staging.rmdir()


def map_episodes(
    work: Callable[[EpisodeStore, Any], Any], store: EpisodeStore, items: Sequence[Any], cluster: Cluster
) -> Generator[Any]:
    """Yield the results of `work(store, item)` in the order of the items, computed on a cluster (UserError: raised by
    `work` or by the cluster)."""
    make_worker = partial(_ExportWorker, work, store.folder.resolve(), len(store.episodes))
    with cluster.pool(make_worker) as pool:
        futures = deque(map(pool.submit, items))
        try:
            yield from track((futures.popleft().result() for _ in items), "exporting", len(items))
        except WorkersLost as error:
            raise WorkersLost(f"{error}; written files are kept, run again to continue") from error


class _ExportWorker:
    """Worker that opens the store once per process."""

    def __init__(self, work: Callable[[EpisodeStore, Any], Any], folder: Path, episodes: int) -> None:
        self._work, self._store = work, EpisodeStore(folder, episodes)

    def attempt(self, item: Any) -> Any:
        """Process one item."""
        return self._work(self._store, item)

    def close(self) -> None:
        """Do nothing: there are no resources to free."""
