"""The goal of not acting on an impossible instruction."""

from __future__ import annotations

import numpy as np

from vla.io.types import Count, Positive
from vla.tasks.language import Grammar
from vla.tasks.tabletop.goals.goal import Goal, Referents, Subgoal, WorldState

AT_REST = 0.05  # speed of the fastest joint below which the arm is at rest [rad/s]


class Stay(Goal):
    """Leave everything in place, because the instruction names a block that is not on the table."""

    absent = 1

    def __init__(self, language: Grammar, unmoved: Positive, hold_steps: Count = 15) -> None:
        """Args: grammar; maximum displacement of any block [m]; consecutive steps for which the arm must rest."""
        super().__init__(language, hold_steps)
        self.unmoved = unmoved

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Keep every block in place and the arm at rest."""
        (block,) = referents.blocks
        moved = np.linalg.norm(state.positions - state.starts, axis=1)
        done = state.arm_speed < AT_REST and bool((moved < self.unmoved).all())
        return [Subgoal(block, state.positions[block], "stay", done)]
