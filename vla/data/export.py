"""Exports of an episode store to layouts that other programs read."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.progress import track

from vla.data.episodes import Entry, EpisodeStore
from vla.spec import Array

MILLIMETRE = np.float32(0.001)  # [m]


class Files:
    """One folder per episode, one folder per step, plain files inside.

        episode_00000/manifest.json                  what the numbers below mean, and how the episode came about
        episode_00000/step_0000/rgb_image.png        (H, W, 3) uint8
        episode_00000/step_0000/depth_image.npy      (H, W) float32 [m], 0 where there is no return
        episode_00000/step_0000/robot_state.json     joint positions [rad] and velocities [rad/s], gripper opening [m]
        episode_00000/step_0000/expert_action.json   the action to imitate and the one that was executed, each (D,)

    With several cameras the two images of each stand in a folder of its name: `step_0000/front/rgb_image.png`.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)

    def export(self, store: EpisodeStore) -> Path:
        """Write the episodes that are not there yet, each whole or not at all; returns the folder.

        Raises:
            ValueError: the folder holds an episode of another store, or the store is damaged.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        for number, entry in enumerate(track(store.episodes, description="exporting")):
            folder = self._folder / f"episode_{number:05d}"
            manifest = _manifest(store, entry)
            if not folder.exists():
                draft = self._folder / f".{folder.name}"
                shutil.rmtree(draft, ignore_errors=True)  # left by an export that was cut short
                _write_episode(draft, store, entry)
                _write_json(draft / "manifest.json", manifest)
                os.rename(draft, folder)
            elif json.loads((folder / "manifest.json").read_text(encoding="utf-8")) != manifest:
                raise ValueError(f"{folder} was exported from other episodes: choose another export.folder")
        return self._folder


def _manifest(store: EpisodeStore, entry: Entry) -> dict[str, Any]:
    return {
        "seed": entry.seed,
        "instruction": entry.instruction,
        "outcome": entry.outcome,
        "steps": entry.steps,
        "draws": entry.draws,
        "crc": entry.crc,
        "spec": store.spec.to_dict(),
    }


def _write_episode(folder: Path, store: EpisodeStore, entry: Entry) -> None:
    rows = store.read(entry)
    cameras = store.spec.cameras
    for step in range(entry.steps):
        place = folder / f"step_{step:04d}"
        for camera in cameras:
            images = place / camera if len(cameras) > 1 else place
            images.mkdir(parents=True)
            Image.fromarray(rows[f"rgb_{camera}"][step]).save(images / "rgb_image.png", compress_level=1)
            np.save(images / "depth_image.npy", rows[f"depth_{camera}"][step] * MILLIMETRE)
        state = {
            "joint_positions": _numbers(rows["joints"][step]),
            "joint_velocities": _numbers(rows["velocities"][step]),
            "gripper_opening": _numbers(rows["gripper"][step])[0],
        }
        _write_json(place / "robot_state.json", state)
        action = {"action": _numbers(rows["action"][step]), "executed": _numbers(rows["executed"][step])}
        _write_json(place / "expert_action.json", action)


def _numbers(values: Array) -> list[float]:
    return [float(value) for value in values]


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
