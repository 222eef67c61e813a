"""The goal of lifting a block."""

from __future__ import annotations

import numpy as np

from vla.io.types import Count, Positive
from vla.tasks.language import Grammar
from vla.tasks.tabletop.goals.goal import Arrangement, Goal, Referents, Subgoal, WorldState


class Lift(Goal):
    """Lift the named block and keep it up."""

    def __init__(self, language: Grammar, height: Positive, hold_steps: Count = 3) -> None:
        """Args: grammar; required height above the start [m]; consecutive steps at that height."""
        super().__init__(language, hold_steps)
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
