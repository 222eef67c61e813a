"""Leave everything as it is: what is asked for cannot be done."""

from __future__ import annotations

import numpy as np

from vla.tasks.goals.goal import Aim, Facts, Goal, Subgoal
from vla.tasks.language import Grammar
from vla.types import Count, Positive

AT_REST = 0.05  # speed of the fastest joint below which the arm counts as resting [rad/s]


class Stay(Goal):
    """Leave everything as it is: what is asked for, of a block that is not there, cannot be done."""

    absent = 1

    def __init__(self, language: Grammar, unmoved: Positive = 0.01, hold_steps: Count = 15) -> None:
        """Args: what is said; how far a block may have moved at most [m]; steps in a row in which the arm must rest."""
        super().__init__(language, hold_steps)
        self.unmoved = unmoved

    def subgoals(self, facts: Facts, aim: Aim) -> list[Subgoal]:
        """Every block where it was, and the arm at rest."""
        (block,) = aim.blocks
        moved = np.linalg.norm(facts.positions - facts.starts, axis=1)
        done = facts.arm_speed < AT_REST and bool((moved < self.unmoved).all())
        return [Subgoal(block, facts.positions[block], "stay", done)]
