"""The collection of a known number of episodes, and what it leaves in a folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

EPISODES = 30
TRIED = 37  # seeds 3, 8, 13, … fail


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "lock"}


def lines(folder: Path) -> int:
    index = folder / "index.jsonl"
    return index.read_bytes().count(b"\n") if index.exists() else 0


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds, or fail after two minutes."""
    give_up = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.01)
