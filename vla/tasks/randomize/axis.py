"""What an axis of randomisation is.

An axis is called once per reset with the bound scene and a stream that depends on the episode's seed and the axis'
name alone, so switching one axis off or changing it leaves what all others draw untouched. It writes into the compiled
model, which was put back to its nominal state, and returns what it drew. Ranges are [low, high], drawn evenly. Axes
are called in the order of the configuration; `null` in place of an axis switches it off.
"""

from __future__ import annotations

from typing import Annotated, Any, Protocol
from zlib import crc32

import numpy as np
from annotated_types import Ge, Le, Predicate

from vla.spec import Array
from vla.tasks.bound import BoundScene
from vla.types import Share, ascending

Length = Annotated[float, Ge(0), Le(1)]  # [m]
Coordinate = Annotated[float, Ge(-2), Le(2)]  # in the base frame, around an arm that reaches less than a metre [m]
Angle = Annotated[float, Ge(-3.2), Le(3.2)]  # [rad]
Lengths = Annotated[tuple[Length, Length], Predicate(ascending)]  # low, high [m]
Places = Annotated[tuple[Coordinate, Coordinate], Predicate(ascending)]  # low, high [m]
Angles = Annotated[tuple[Angle, Angle], Predicate(ascending)]  # low, high [rad]
Shares = Annotated[tuple[Share, Share], Predicate(ascending)]  # low, high


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
