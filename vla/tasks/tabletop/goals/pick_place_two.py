"""The goal of placing two blocks, each on its pad."""

from __future__ import annotations

import numpy as np

from vla.tasks.tabletop.goals.goal import Referents, Subgoal, WorldState, placed
from vla.tasks.tabletop.goals.pick_place import PickPlace

LEFT = 0.06  # distance at which the tool has left a block [m]


class PickPlaceTwo(PickPlace):
    """Put one named block on one named pad, then another one on the other."""

    named, moves, pads = 2, 2, 2

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place and leave the first block, then place the second."""
        (first, second), (one, other) = referents.blocks, referents.pads
        left = bool(np.linalg.norm(state.tool - state.positions[first]) > LEFT)
        done = placed(state, first, one, self.radius) and left, placed(state, second, other, self.radius)
        return [
            Subgoal(first, state.on_table(first, state.pads[one]), "place", done[0]),
            Subgoal(second, state.on_table(second, state.pads[other]), "place", done[1]),
        ]
