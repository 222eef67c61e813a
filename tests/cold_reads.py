"""Windows per second out of a store that is not in memory, for docs/results/speed.md: `python tests/cold_reads.py DIR`,
where DIR is larger than a quarter of the memory.

Reads the same random rows of all images as memory-mapped arrays, and as training reads them. Before each, the store's
files are dropped from the page cache, which changes nothing on the disk. Linux only.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

from vla.data.episodes import EpisodeStore

BATCH = 64
SECONDS = 10.0


def disk_bytes() -> int:
    """What this process has read from disks."""
    lines = Path("/proc/self/io").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("read_bytes")))


def main(folder: Path) -> None:
    store = EpisodeStore(folder)
    fields = [f"rgb_{camera}" for camera in store.spec.cameras]
    for name, scattered in (("memory-mapped arrays", False), ("as training reads", True)):
        for file in (path for field in fields for path in folder.glob(f"{field}.*")):
            with file.open("rb") as opened:
                os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        images, random = [store.rows(field, scattered) for field in fields], np.random.default_rng(0)
        started, before, windows = time.perf_counter(), disk_bytes(), 0
        while (seconds := time.perf_counter() - started) < SECONDS:
            rows = random.integers(0, images[0].shape[0], BATCH)
            for each in images:
                each.take(rows, axis=0)
            windows += BATCH
        of_disk = (disk_bytes() - before) / windows / 1000
        print(f"{name}: {windows / seconds:.0f} windows/s, {of_disk:.0f} kB of disk each")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
