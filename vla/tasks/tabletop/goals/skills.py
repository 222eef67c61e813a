"""The goals that one instruction sets, one class each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from vla.io.types import Positive
from vla.tasks.tabletop.goals.goal import AT_REST, Arrangement, Goal, Referents, Subgoal, WorldState
from vla.tasks.tabletop.language import Grammar, Silence
from vla.tasks.tabletop.scene import PADS

Pads = Annotated[int, Ge(1), Le(len(PADS))]

LEFT = 0.06  # distance at which the tool has left a block [m]
SAG = 0.006  # tolerance of a stacked block's height [m]
UP = np.array([0.0, 0.0, 1.0])
ARM_AT_REST = 0.05  # speed of the fastest joint below which the arm is at rest [rad/s]
REST_STEPS = 15  # consecutive control steps for which it must rest
UNMOVED = 0.01  # largest displacement of a block that counts as none [m]


@dataclass(eq=False)
class Lift(Goal):
    """Lift the named block and keep it up."""

    height: Positive  # required above the start [m]

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Hold the block a little above the required height."""
        (block,) = referents.blocks
        start = state.starts[block, 2]
        destination = np.array([*state.positions[block, :2], start + self.height + 0.03])
        done = state.held[block] and state.positions[block, 2] - start > self.height
        return [Subgoal(block, destination, "hold", bool(done))]

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`."""
        (block,) = referents.blocks
        possible = arrangement.held is None and arrangement.can_grasp(block)
        return arrangement.lift(block) if possible else None


@dataclass(eq=False)
class PickPlace(Goal):
    """Put the named block on the pad and let go of it."""

    radius: Positive  # maximum distance between the centres of block and pad [m]

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place the block on the pad's centre."""
        return [self._place_subgoal(state, referents.blocks[0], referents.pads[0])]

    def _place_subgoal(self, state: WorldState, block: int, pad: int, further: bool = True) -> Subgoal:
        """Return the subgoal that a block rests on a pad, released; it also takes the condition `further`."""
        rests = state.away(block, state.pads[pad]) < self.radius and state.resting(block)
        return Subgoal(block, state.on_table(block, state.pads[pad]), "place", rests and further)


class PickPlaceTwo(PickPlace):
    """Put one named block on one named pad, then another one on the other."""

    named, moves, pads = 2, 2, 2

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place and leave the first block, then place the second."""
        (first, second), (first_pad, second_pad) = referents.blocks, referents.pads
        has_left = bool(np.linalg.norm(state.tool - state.positions[first]) > LEFT)
        return [self._place_subgoal(state, first, first_pad, has_left), self._place_subgoal(state, second, second_pad)]


class Place(PickPlace):
    """Put the named block on the named pad of two and let go of it."""

    pads = 2

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`."""
        (block,), (pad, _) = referents.blocks, referents.pads
        return arrangement.put(block, ("pad", pad)) if arrangement.can_grasp(block) else None


@dataclass(eq=False)
class Push(Goal):
    """Push the named block onto the named pad without lifting it."""

    pads = 2
    radius: Positive  # largest distance between the centres of block and pad [m]
    highest: Positive  # largest rise of the block above its start, while the instruction is carried out [m]

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Push the block onto the pad's centre."""
        (block,), (pad, _) = referents.blocks, referents.pads
        on_pad = state.away(block, state.pads[pad]) < self.radius and state.speeds[block] < AT_REST
        done = bool(on_pad and state.lifts[block] < self.highest)
        return [Subgoal(block, state.on_table(block, state.pads[pad]), "push", done)]

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`: the block must stand on the table, and the gripper be empty."""
        (block,), (pad, _) = referents.blocks, referents.pads
        possible = arrangement.held is None and arrangement.can_grasp(block) and not arrangement.is_stacked(block)
        return arrangement.put(block, ("pad", pad)) if possible else None


class Stack(Goal):
    """Put one named block on top of another and let go of it."""

    named, blocks = 2, 3  # with two blocks the lower one would be unambiguous

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place the upper block centred on top of the lower one."""
        upper, lower = referents.blocks
        top = state.positions[lower] + UP * state.extents[lower, 2]
        destination = top + UP * state.extents[upper, 2]
        is_free = state.speeds[upper] < AT_REST and not state.touched[upper]
        level = abs(state.positions[upper, 2] - destination[2]) < SAG
        done = bool(is_free and level and state.away(upper, top) < state.extents[lower, 0])
        return [Subgoal(upper, destination, "place", done, tolerance=0.007)]

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`: towers have two blocks."""
        upper, lower = referents.blocks
        return arrangement.put(upper, ("block", lower)) if arrangement.can_grasp(upper) else None


class Stay(Goal):
    """Leave everything in place, because the instruction names a block that is not on the table."""

    def __init__(self, language: Grammar, pads: Pads) -> None:
        """Take a grammar and the number of pads on the table."""
        self.pads, self.absent = pads, absent_colours_needed(language)
        super().__init__(language, REST_STEPS)

    @classmethod
    def instead_of(cls, goal: Goal) -> Stay:
        """Return the goal with the instructions of another one, except that their first block is absent."""
        return cls(goal.language.rename({"block": "absent", "other": "block"}), goal.pads)

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Keep every block in place and the arm at rest."""
        (block,) = referents.blocks
        distances = np.linalg.norm(state.positions - state.starts, axis=1)
        done = state.arm_speed < ARM_AT_REST and bool((distances < UNMOVED).all())
        return [Subgoal(block, state.positions[block], "stay", done)]


class Wait(Stay):
    """Leave everything in place, because the instruction is empty."""

    def __init__(self, pads: Pads) -> None:
        """Take the number of pads on the table."""
        super().__init__(Silence(), pads)
        self.absent = 0


def absent_colours_needed(language: Grammar) -> int:
    """Return how many colours to keep absent from the table, so that at least one of them is not held out."""
    return 1 + len(language.held_out_colours)
