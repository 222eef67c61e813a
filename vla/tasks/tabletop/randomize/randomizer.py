"""The protocol of an axis of domain randomisation, and its parameter types.

A randomizer is called once per reset, after the compiled model is restored to nominal, in the order of the config. Its
random stream depends only on the episode's seed and the axis' name, so changing or disabling one axis does not change
the draws of another. Ranges are [low, high] and sampled uniformly. `null` in the config disables an axis.
"""

from __future__ import annotations

from typing import Annotated, Any, Protocol

import numpy as np
from annotated_types import Ge, Le, Predicate

from vla.io.types import Share, ascending
from vla.spec import Array
from vla.tasks.tabletop.compiled_scene import CompiledScene

Length = Annotated[float, Ge(0), Le(1)]  # [m]
Coordinate = Annotated[float, Ge(-2), Le(2)]  # in the base frame [m]
Angle = Annotated[float, Ge(-3.2), Le(3.2)]  # [rad]
Lengths = Annotated[tuple[Length, Length], Predicate(ascending)]  # low, high [m]
Places = Annotated[tuple[Coordinate, Coordinate], Predicate(ascending)]  # low, high [m]
Angles = Annotated[tuple[Angle, Angle], Predicate(ascending)]  # low, high [rad]
Shares = Annotated[tuple[Share, Share], Predicate(ascending)]  # low, high


class Randomizer(Protocol):
    """One axis of randomisation."""

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Sample, write the sample into the compiled model or the state, and return it as plain values."""


def round_values(values: Array) -> list[Any]:
    """Round to five decimals."""
    return np.round(values, 5).tolist()
