"""Lift the named block and keep it up."""

from __future__ import annotations

import numpy as np

from vla.tasks.goals.goal import Aim, Facts, Goal, Subgoal
from vla.tasks.language import Grammar
from vla.types import Count, Positive


class Lift(Goal):
    """Lift the named block and keep it up."""

    def __init__(self, language: Grammar, height: Positive = 0.10, hold_steps: Count = 3) -> None:
        """Args: what is said; how high the block must be above where it stood [m]; steps it must stay there."""
        super().__init__(language, hold_steps)
        self.height = height

    def subgoals(self, facts: Facts, aim: Aim) -> list[Subgoal]:
        """Straight above where the block is, a little higher than asked."""
        (block,) = aim.blocks
        start = facts.starts[block, 2]
        destination = np.array([*facts.positions[block, :2], start + self.height + 0.03])
        done = facts.held[block] and facts.positions[block, 2] - start > self.height
        return [Subgoal(block, destination, "hold", bool(done))]
