"""Put one named block on top of another."""

from __future__ import annotations

import numpy as np

from vla.tasks.goals.goal import AT_REST, Aim, Facts, Goal, Subgoal
from vla.tasks.language import Grammar
from vla.types import Count

UP = np.array([0.0, 0.0, 1.0])
SAG = 0.006  # how far a stacked block may be from the height that its size says [m]


class Stack(Goal):
    """Put one named block on top of another and let go of it."""

    named, blocks = 2, 3  # with two, "the other one" would need no words

    def __init__(self, language: Grammar, hold_steps: Count = 3) -> None:
        """Args: what is said; steps that the upper block must rest."""
        super().__init__(language, hold_steps)

    def subgoals(self, facts: Facts, aim: Aim) -> list[Subgoal]:
        """On the top of the lower block, its centre above it."""
        upper, lower = aim.blocks
        top = facts.positions[lower] + UP * facts.extents[lower, 2]
        destination = top + UP * facts.extents[upper, 2]
        free = facts.speeds[upper] < AT_REST and not facts.touched[upper]
        level = abs(facts.positions[upper, 2] - destination[2]) < SAG
        done = bool(free and level and facts.away(upper, top) < facts.extents[lower, 0])
        return [Subgoal(upper, destination, "place", done, tolerance=0.007)]
