"""The goals of not acting: on an impossible instruction, and without one."""

from __future__ import annotations

import numpy as np

from vla.io.types import Count
from vla.tasks.tabletop.goals.goal import Goal, Referents, Subgoal, WorldState
from vla.tasks.tabletop.language import Grammar, Silence

ARM_AT_REST = 0.05  # speed of the fastest joint below which the arm is at rest [rad/s]
REST_STEPS = 15  # consecutive control steps for which it must rest
UNMOVED = 0.01  # largest displacement of a block that counts as none [m]


def absent_colours_needed(language: Grammar) -> int:
    """Return the number of colours to keep absent from the table, so that one of them is not held out from training."""
    return 1 + len(language.held_out_colours)


class Stay(Goal):
    """Leave everything in place, because the instruction names a block that is not on the table."""

    def __init__(self, language: Grammar, pads: Count) -> None:
        """Args: grammar; number of pads on the table."""
        self.pads, self.absent = pads, absent_colours_needed(language)
        super().__init__(language, REST_STEPS)

    @classmethod
    def instead_of(cls, goal: Goal) -> Stay:
        """Return the goal for the instructions of another one, but for the first block, which is absent."""
        return cls(goal.language.renamed({"block": "absent", "other": "block"}), goal.pads)

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Keep every block in place and the arm at rest."""
        (block,) = referents.blocks
        moved = np.linalg.norm(state.positions - state.starts, axis=1)
        done = state.arm_speed < ARM_AT_REST and bool((moved < UNMOVED).all())
        return [Subgoal(block, state.positions[block], "stay", done)]


class Wait(Stay):
    """Leave everything in place, because the instruction is empty."""

    def __init__(self, pads: Count) -> None:
        """Args: number of pads on the table."""
        super().__init__(Silence(), pads)
        self.absent = 0
