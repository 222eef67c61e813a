"""What an axis of randomisation is.

An axis is called once per reset with the bound scene and a stream that depends on the episode's seed and the axis'
name alone, so switching one axis off or changing it leaves what all others draw untouched. It writes into the compiled
model, which was put back to its nominal state, and returns what it drew. Ranges are [low, high], drawn evenly. Axes
are called in the order of the configuration; `null` in place of an axis switches it off.
"""

from __future__ import annotations

from typing import Any, Protocol
from zlib import crc32

import numpy as np

from vla.spec import Array
from vla.tasks.bound import BoundScene

Range = tuple[float, float]  # low, high


class Axis(Protocol):
    """One thing that differs between episodes."""

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Write a draw into the compiled model or the state; returns it as plain numbers, lists and strings."""
        ...


class Streams:
    """The random streams of an environment, by axis; kept, because making one takes ten times as long as seeding it."""

    def __init__(self) -> None:
        self._made: dict[str, np.random.RandomState] = {}

    def __call__(self, seed: int, axis: str) -> np.random.RandomState:
        """The stream of one axis at the beginning of one episode."""
        if axis not in self._made:
            self._made[axis] = np.random.RandomState()
        self._made[axis].seed(np.random.SeedSequence([seed, crc32(axis.encode())]).generate_state(8))
        return self._made[axis]


def rounded(values: Array) -> list[Any]:
    """As numbers that are short to write down."""
    return np.round(values, 5).tolist()
