"""The goal of pushing a block onto a pad."""

from __future__ import annotations

from vla.io.types import Inherited, Positive
from vla.tasks.tabletop.goals.goal import AT_REST, Arrangement, Goal, Referents, Subgoal, WorldState


class Push(Goal):
    """Push the named block onto the named pad without lifting it."""

    pads = 2

    def __init__(self, radius: Positive, highest: Positive, **inherited: Inherited) -> None:
        """Args: largest distance between the centres of block and pad, and largest rise of the block above its start,
        while the instruction is carried out [m]."""
        super().__init__(**inherited)
        self.radius, self.highest = radius, highest

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Push the block onto the pad's centre."""
        (block,), (pad, _) = referents.blocks, referents.pads
        there = state.away(block, state.pads[pad]) < self.radius and state.speeds[block] < AT_REST
        done = bool(there and state.lifts[block] < self.highest)
        return [Subgoal(block, state.on_table(block, state.pads[pad]), "push", done)]

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`: the block must stand on the table, and the gripper be empty."""
        (block,), (pad, _) = referents.blocks, referents.pads
        possible = arrangement.held is None and arrangement.allows(block) and block not in arrangement.on_blocks
        return arrangement.on_pad(block, pad) if possible else None
