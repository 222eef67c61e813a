"""Randomizer of what happens in the course of an episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen, Predicate

from vla.io.types import NaturalRange, unique
from vla.tasks.tabletop.compiled_scene import CompiledScene, Disturbance, Kind
from vla.tasks.tabletop.randomize.randomizer import Lengths, Places


@dataclass(frozen=True)
class Disturbances:
    """Pushes of the arm, drops of the held block, and moves of the block or its destination, one kind per episode."""

    kinds: Annotated[Sequence[Kind], MinLen(1), Predicate(unique)]  # to draw from
    times: NaturalRange  # range of how often it happens
    start: NaturalRange  # range of the number of control steps before a push, not counting the first step
    delay: NaturalRange  # the same for other kinds: steps whose preconditions hold before the disturbance happens
    push: Lengths  # range of the distance by which the arm is pushed [m]
    move: Lengths  # of that by which an object is moved [m]
    x: Places  # area of the table in which a push or a move ends [m]
    y: Places

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw kind, number, time, distance and direction; whether it happens also depends on the agent."""
        # The same numbers at every level.
        kind, times, delay, distance, angle = random_state.uniform(size=5).tolist()
        chosen = self.kinds[int(kind * len(self.kinds))]
        number = _whole(self.times, times)
        if number == 0:
            return {"kind": "none", "times": 0, "delay": 0, "distance": 0.0, "angle": 0.0}
        low, high = (0.0, 0.0) if chosen == "drop" else self.push if chosen == "push" else self.move
        drawn = {
            "kind": chosen,
            "times": number,
            "delay": _whole(self.start if chosen == "push" else self.delay, delay),
            "distance": round(low + distance * (high - low), 5),
            "angle": round(2 * math.pi * angle, 5),
        }
        low_corner, high_corner = zip(self.x, self.y, strict=True)
        scene.disturbance = Disturbance(**drawn, low=low_corner, high=high_corner)
        return drawn


def _whole(bounds: tuple[int, int], share: float) -> int:
    """Return the integer of a range, ends included, at a share 0…1 of it."""
    low, high = bounds
    return low + int(share * (high - low + 1))
