"""Put one named block on one named pad, then another one on the other."""

from __future__ import annotations

import numpy as np

from vla.tasks.goals.goal import Aim, Facts, Goal, Subgoal, placed
from vla.tasks.language import Grammar
from vla.types import Count, Positive

CLEAR = 0.06  # distance of the tool from a block that is left alone [m]


class PickPlaceTwo(Goal):
    """Put one named block on one named pad, then another one on the other."""

    named, moves, pads = 2, 2, 2

    def __init__(self, language: Grammar, radius: Positive = 0.04, hold_steps: Count = 3) -> None:
        """Args: what is said; how far from a pad's centre a block's may rest [m]; steps both must rest."""
        super().__init__(language, hold_steps)
        self.radius = radius

    def subgoals(self, facts: Facts, aim: Aim) -> list[Subgoal]:
        """The first block, which must be left alone again, then the second."""
        (first, second), (one, other) = aim.blocks, aim.pads
        left = bool(np.linalg.norm(facts.tool - facts.positions[first]) > CLEAR)
        done = placed(facts, first, one, self.radius) and left, placed(facts, second, other, self.radius)
        return [
            Subgoal(first, facts.on_table(first, facts.pads[one]), "place", done[0]),
            Subgoal(second, facts.on_table(second, facts.pads[other]), "place", done[1]),
        ]
