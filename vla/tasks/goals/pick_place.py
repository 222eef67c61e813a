"""Put the named block on the pad and let go of it."""

from __future__ import annotations

from vla.tasks.goals.goal import Aim, Facts, Goal, Subgoal, placed
from vla.tasks.language import Grammar
from vla.types import Count, Positive


class PickPlace(Goal):
    """Put the named block on the pad and let go of it."""

    def __init__(self, language: Grammar, radius: Positive = 0.04, hold_steps: Count = 3) -> None:
        """Args: what is said; how far from the pad's centre the block's may rest [m]; steps it must rest."""
        super().__init__(language, hold_steps)
        self.radius = radius

    def subgoals(self, facts: Facts, aim: Aim) -> list[Subgoal]:
        """On the pad's centre."""
        (block,), (pad,) = aim.blocks, aim.pads
        done = placed(facts, block, pad, self.radius)
        return [Subgoal(block, facts.on_table(block, facts.pads[pad]), "place", done)]
