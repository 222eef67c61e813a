"""Windows per second of LeRobot's loader on a dataset from `export=lerobot`; needs lerobot and nothing of vla.

python lerobot_windows.py FOLDER FRAMES SECONDS      prints the rate of one process, at random windows
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def windows_per_second(folder: Path, frames: int, seconds: float) -> float:
    """Return the rate of windows of `frames` frames of all cameras, state and action, after one as a warm-up."""
    info = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
    times = [age / info["fps"] for age in range(1 - frames, 1)]
    seen = [name for name in info["features"] if name.startswith("observation.")]
    dataset = LeRobotDataset("local", root=folder, delta_timestamps=dict.fromkeys(seen, times), video_backend="pyav")
    order = np.random.default_rng(0).integers(0, len(dataset), 100_000).tolist()
    assert dataset[order[0]]
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        assert dataset[order[count + 1]]
        count += 1
    return count / (time.perf_counter() - started)


if __name__ == "__main__":
    print(windows_per_second(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
