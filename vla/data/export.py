"""Exports of an episode store to layouts that other programs read: what they share, and the plainest of them."""

from __future__ import annotations

import json
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from PIL import Image
from rich.progress import track

from vla.data.episodes import EpisodeStore
from vla.data.index import Entry
from vla.documents import read_json
from vla.files import writing
from vla.spec import Array, Spec
from vla.types import Count, Text
from vla.workers import Pool, WorkersLost, cores

MILLIMETRE = np.float32(0.001)  # [m]

Item = TypeVar("Item")
Result = TypeVar("Result")


class Folders(ABC):
    """A layout with one folder per episode, in which `manifest.json` says how the episode came about.

    Args:
        folder: where to write.
        workers: processes; null: one per core. The files do not depend on it.
    """

    def __init__(self, folder: Text | Path, workers: Count | None = None) -> None:
        self._folder = Path(folder).resolve()
        self._workers = workers

    def export(self, store: EpisodeStore) -> Path:
        """Write the episodes that are not there yet, each whole or not at all; returns the folder.

        Raises:
            ValueError: the folder holds an episode of another store, or the store is damaged.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        with unfinished(self._folder) as place:
            missing = [number for number in range(len(store.episodes)) if not self._is_there(store, number)]
            for _ in each(partial(self._export, place), store, missing, self._workers):
                pass
        return self._folder

    def _is_there(self, store: EpisodeStore, number: int) -> bool:
        folder = self._folder / f"episode_{number:05d}"
        if not folder.exists():
            return False
        manifest = self._manifest(store, number)
        if read_json(folder / "manifest.json", dict[str, Any]) != manifest:
            raise ValueError(
                f"{folder} was exported from other episodes, or as other files: choose another export.folder"
            )
        return True

    def _manifest(self, store: EpisodeStore, number: int) -> dict[str, Any]:
        entry, layout = store.episodes[number], {"layout": type(self).__name__, **self.settings()}
        return origin(entry) | layout | {"spec": store.spec.to_dict()}

    def _export(self, place: Path, store: EpisodeStore, number: int) -> None:
        entry = store.episodes[number]
        draft = place / f"episode_{number:05d}"
        shutil.rmtree(draft, ignore_errors=True)  # left by an export that was cut short
        self.write(draft, store.spec, entry, store.read(entry))
        write_json(draft / "manifest.json", self._manifest(store, number))
        os.rename(draft, self._folder / draft.name)

    def settings(self) -> dict[str, Any]:
        """What else the files depend on, fit for JSON."""
        return {}

    @abstractmethod
    def write(self, folder: Path, spec: Spec, entry: Entry, rows: dict[str, Array]) -> None:
        """Write the (steps, …) rows of an episode's fields into `folder`, which does not exist yet."""


class Files(Folders):
    """One folder per episode, one folder per step, plain files inside.

        episode_00000/manifest.json                  what the numbers below mean, and how the episode came about
        episode_00000/step_0000/rgb_image.png        (H, W, 3) uint8
        episode_00000/step_0000/depth_image.npy      (H, W) float32 [m], 0 where there is no return
        episode_00000/step_0000/robot_state.json     joint positions [rad] and velocities [rad/s], gripper opening [m]
        episode_00000/step_0000/expert_action.json   the action to imitate and the one that was executed, each (D,)

    With several cameras the two images of each stand in a folder of its name: `step_0000/front/rgb_image.png`.
    """

    def write(self, folder: Path, spec: Spec, entry: Entry, rows: dict[str, Array]) -> None:
        """Write one episode."""
        for step in range(entry.steps):
            place = folder / f"step_{step:04d}"
            for camera in spec.cameras:
                images = place / camera if len(spec.cameras) > 1 else place
                images.mkdir(parents=True)
                Image.fromarray(rows[f"rgb_{camera}"][step]).save(images / "rgb_image.png", compress_level=1)
                np.save(images / "depth_image.npy", rows[f"depth_{camera}"][step] * MILLIMETRE)
            state = {
                "joint_positions": _numbers(rows["joints"][step]),
                "joint_velocities": _numbers(rows["velocities"][step]),
                "gripper_opening": _numbers(rows["gripper"][step])[0],
            }
            write_json(place / "robot_state.json", state)
            action = {"action": _numbers(rows["action"][step]), "executed": _numbers(rows["executed"][step])}
            write_json(place / "expert_action.json", action)


def origin(entry: Entry) -> dict[str, Any]:
    """How an episode came about, and the checksum of what came of it, fit for JSON."""
    return {
        "seed": entry.seed,
        "instruction": entry.instruction,
        "outcome": entry.outcome,
        "steps": entry.steps,
        "draws": entry.draws,
        "crc": entry.crc,
    }


def write_json(path: Path, value: Any) -> None:
    """Write readable JSON."""
    path.write_text(json.dumps(value, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")


def require_empty(folder: Path) -> None:
    """Refuse to export to a folder that holds something.

    Raises:
        ValueError: it does, or it is a file.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} holds something else than these episodes: choose another export.folder")


@contextmanager
def unfinished(folder: Path) -> Iterator[Path]:
    """A hidden folder beside `folder` for what is not whole yet; it is removed at the end, and stays where that fails.

    Raises:
        ValueError: another process is exporting to `folder`.
        OSError: the disk does not take it; the message names `folder`.
    """
    place = folder.with_name(f".{folder.name}.unfinished")
    place.mkdir(parents=True, exist_ok=True)
    lock = FileLock(place / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise ValueError(f"another export to {folder} is under way: wait, or choose another export.folder") from error
    try:
        with writing(folder):
            yield place
        shutil.rmtree(place)
    finally:
        with suppress(OSError):  # where nothing was begun, nothing needs to stay
            (place / "lock").unlink()
            place.rmdir()
        lock.release()


def each(
    work: Callable[[EpisodeStore, Item], Result], store: EpisodeStore, items: Sequence[Item], workers: int | None
) -> Generator[Result]:
    """What `work` makes of the store and each of the items, in their order; null workers: one process per core.

    Raises:
        ValueError: a process crashed twice; what `work` itself raises comes through.
    """
    workers = min(workers or cores(), len(items))
    if workers <= 1:
        yield from track((work(store, item) for item in items), "exporting", len(items))
        return
    make = partial(_Exporting, work, store.folder, len(store.episodes))
    with Pool(make, workers, "export.workers") as pool:
        futures = [pool.submit(item) for item in items]
        try:
            yield from track((future.result() for future in futures), "exporting", len(items))
        except WorkersLost as lost:
            raise ValueError(
                f"an exporting process crashed twice: {lost}. What is written stays; run again to go on, with "
                "export.workers=1 for the traceback"
            ) from lost


class _Exporting(Generic[Item, Result]):
    """The store and what is made of it, in a worker process."""

    def __init__(self, work: Callable[[EpisodeStore, Item], Result], folder: Path, episodes: int) -> None:
        self._work, self._store = work, EpisodeStore(folder, episodes)

    def attempt(self, item: Item) -> Result:
        """What becomes of one item."""
        return self._work(self._store, item)

    def close(self) -> None:
        """Nothing to free."""


def _numbers(values: Array) -> list[float]:
    return [float(value) for value in values]
