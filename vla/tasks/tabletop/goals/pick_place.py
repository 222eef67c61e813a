"""The goal of placing a block on a pad."""

from __future__ import annotations

from vla.io.types import Inherited, Positive
from vla.tasks.tabletop.goals.goal import Goal, Referents, Subgoal, WorldState, placed


class PickPlace(Goal):
    """Put the named block on the pad and let go of it."""

    def __init__(self, radius: Positive, **inherited: Inherited) -> None:
        """Args: maximum distance between the centres of block and pad [m]."""
        super().__init__(**inherited)
        self.radius = radius

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place the block on the pad's centre."""
        (block,), (pad, *_) = referents.blocks, referents.pads
        done = placed(state, block, pad, self.radius)
        return [Subgoal(block, state.on_table(block, state.pads[pad]), "place", done)]
