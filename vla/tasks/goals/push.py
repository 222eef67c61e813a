"""Push the named block onto the named pad without lifting it."""

from __future__ import annotations

from vla.tasks.goals.goal import AT_REST, Aim, Facts, Goal, Subgoal
from vla.tasks.language import Grammar
from vla.types import Count, Positive


class Push(Goal):
    """Push the named block onto the named pad without lifting it."""

    pads = 2

    def __init__(
        self, language: Grammar, radius: Positive = 0.04, highest: Positive = 0.02, hold_steps: Count = 3
    ) -> None:
        """Args: what is said; how far from the pad's centre the block's may rest [m]; how far it may ever have left the
        table [m]; steps it must rest."""
        super().__init__(language, hold_steps)
        self.radius, self.highest = radius, highest

    def subgoals(self, facts: Facts, aim: Aim) -> list[Subgoal]:
        """On the pad's centre."""
        (block,), (pad, _) = aim.blocks, aim.pads
        there = facts.away(block, facts.pads[pad]) < self.radius and facts.speeds[block] < AT_REST
        done = bool(there and facts.lifts[block] < self.highest)
        return [Subgoal(block, facts.on_table(block, facts.pads[pad]), "push", done)]
