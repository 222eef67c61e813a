"""The goal of placing a block on a pad."""

from __future__ import annotations

from vla.io.types import Count, Positive
from vla.tasks.language import Grammar
from vla.tasks.tabletop.goals.goal import Goal, Referents, Subgoal, WorldState, placed


class PickPlace(Goal):
    """Put the named block on the pad and let go of it."""

    def __init__(self, language: Grammar, radius: Positive, hold_steps: Count = 3) -> None:
        """Args: grammar; maximum distance between the centres of block and pad [m]; consecutive steps at rest."""
        super().__init__(language, hold_steps)
        self.radius = radius

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place the block on the pad's centre."""
        (block,), (pad, *_) = referents.blocks, referents.pads
        done = placed(state, block, pad, self.radius)
        return [Subgoal(block, state.on_table(block, state.pads[pad]), "place", done)]
