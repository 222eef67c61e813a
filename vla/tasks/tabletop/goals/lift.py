"""The goal of lifting a block."""

from __future__ import annotations

import numpy as np

from vla.io.types import Inherited, Positive
from vla.tasks.tabletop.goals.goal import Arrangement, Goal, Referents, Subgoal, WorldState


class Lift(Goal):
    """Lift the named block and keep it up."""

    def __init__(self, height: Positive, **inherited: Inherited) -> None:
        """Args: required height above the start [m]."""
        super().__init__(**inherited)
        self.height = height

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Hold the block a little above the required height."""
        (block,) = referents.blocks
        start = state.starts[block, 2]
        destination = np.array([*state.positions[block, :2], start + self.height + 0.03])
        done = state.held[block] and state.positions[block, 2] - start > self.height
        return [Subgoal(block, destination, "hold", bool(done))]

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`."""
        (block,) = referents.blocks
        possible = arrangement.held is None and arrangement.allows(block)
        return arrangement.lifted(block) if possible else None
