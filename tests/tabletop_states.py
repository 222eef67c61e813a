"""States of the world for tests of goals and outcomes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla.spec import Array
from vla.tasks.tabletop.goals.goal import WorldState

PADS = np.array([[0.5, 0.0, 0.0], [0.5, 0.2, 0.0]])

HALF = 0.02


def state(
    positions: Array,
    held: Sequence[bool] | None = None,
    tool: Array | None = None,
    speed: float = 0.0,
    lifts: Sequence[float] | None = None,
) -> WorldState:
    """Build the state of resting or held cubes and two pads."""
    count = len(positions)
    grip = np.array(held if held is not None else [False] * count)
    return WorldState(
        positions=positions,
        starts=np.tile([0.4, 0.2, HALF], (count, 1)),
        extents=np.full((count, 3), HALF),
        speeds=np.full(count, speed),
        lifts=np.array(lifts if lifts is not None else [0.0] * count),
        held=grip,
        touched=grip,
        pads=PADS,
        tool=np.array([0.3, 0.0, 0.3]) if tool is None else tool,
    )
