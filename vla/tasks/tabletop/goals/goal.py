"""The base class of goals: named objects, language and subgoals."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vla.io.errors import UserError
from vla.io.types import Count
from vla.spec import Array
from vla.tasks.tabletop.language import Grammar

AT_REST = 0.02  # speed below which a block is at rest [m/s]

SLOTS = frozenset({"block", "other", "pad", "rest", "absent"})  # of instructions, which goals fill

Skill = Literal["place", "hold", "push", "stay"]
SKILLS: tuple[Skill, ...] = ("place", "hold", "push", "stay")
Spot = tuple[Literal["pad", "block"], int]  # a pad or a block, by its index, where a block can be put


@dataclass(frozen=True)
class WorldState:
    """True state of the world after a step; B blocks on the table, Z pads."""

    positions: Array  # (B, 3) centres of the blocks [m]
    starts: Array  # (B, 3) centres when the instruction was given [m]
    extents: Array  # (B, 3) half sizes, upright [m]
    speeds: Array  # (B,) of the centres [m/s]
    lifts: Array  # (B,) largest height above the start so far [m]
    held: Array  # (B,) both fingertips touch the block
    touched: Array  # (B,) at least one fingertip touches the block
    pads: Array  # (Z, 3) centres [m]
    tool: Array  # (3,) point between the fingertips [m]
    arm_speed: float = 0.0  # of the fastest joint [rad/s]

    def away(self, block: int, place: Array) -> float:
        """Return the horizontal distance between a block's centre and a place [m]."""
        return float(np.hypot(*(self.positions[block] - place)[:2]))

    def resting(self, block: int) -> bool:
        """Return whether a block rests on the table, untouched by the gripper."""
        low = self.positions[block, 2] < 1.5 * self.extents[block].max()
        return bool(low and self.speeds[block] < AT_REST and not self.touched[block])

    def on_table(self, block: int, place: Array) -> Array:
        """Return the centre (3,) [m] of a block that stands on the table at `place`."""
        return np.array([place[0], place[1], self.extents[block, 2]])


@dataclass(frozen=True)
class Referents:
    """Indices of the blocks and pads that the instruction names, in that order."""

    blocks: tuple[int, ...]
    pads: tuple[int, ...]


@dataclass(frozen=True)
class Arrangement:
    """Places of the blocks after instructions were carried out; a block without a place lies free on the table."""

    spots: Mapping[int, Spot] = field(default_factory=dict)  # block → where it is
    held: int | None = None  # block in the gripper

    def is_stacked(self, block: int) -> bool:
        """Return whether a block stands on another one."""
        return block in self.spots and self.spots[block][0] == "block"

    def can_grasp(self, block: int) -> bool:
        """Return whether the gripper can take a block or holds it: no other block is held, and none stands on it."""
        return self.held in (None, block) and ("block", block) not in self.spots.values()

    def lift(self, block: int) -> Arrangement:
        """Return the arrangement with a block in the gripper."""
        return Arrangement({other: spot for other, spot in self.spots.items() if other != block}, block)

    def put(self, block: int, spot: Spot) -> Arrangement | None:
        """Return the arrangement with a block released at a spot; None if the spot is taken, or is on a tower."""
        if spot in self.spots.values() or (spot[0] == "block" and self.is_stacked(spot[1])):
            return None
        return Arrangement({**self.spots, block: spot})


@dataclass(frozen=True)
class Subgoal:
    """One skill to apply to one block."""

    block: int
    destination: Array  # (3,) of its centre [m]
    skill: Skill  # "place" releases the block there, "hold" keeps it there, "push" moves it there, "stay" leaves it
    done: bool
    tolerance: float = 0.02  # horizontal distance from the destination at which to release the block [m]


def current_subgoal(subgoals: Sequence[Subgoal]) -> Subgoal:
    """Return the first subgoal that is not done, or the last one."""
    return next((subgoal for subgoal in subgoals if not subgoal.done), subgoals[-1])


@dataclass(eq=False)
class Goal(ABC):
    """One kind of task.

    Attributes:
        named: number of blocks that the instruction names.
        moves: number of the named blocks to be moved.
        blocks: minimum number of blocks on the table.
        absent: minimum number of colours that no block has.
        pads: number of pads on the table.
        language: grammar of the instructions; the slots {block} and {other} are the colours of the named blocks,
            {absent} a colour that no block has, {pad} and {rest} the colours of the pads.
        hold_steps: consecutive control steps for which all subgoals must be done.
    """

    named, moves, blocks, absent, pads = 1, 1, 2, 0, 1
    language: Grammar
    hold_steps: Count

    def __post_init__(self) -> None:
        language = self.language
        slots = ["block", "other"][: self.named] + ["pad", "rest"][: self.pads] + ["absent"] * bool(self.absent)
        if extra_slots := sorted(language.slots - set(slots)):
            raise UserError(f"task.goal.language has the slots {extra_slots}, but {type(self).__name__} fills {slots}")
        if clash := sorted(SLOTS & {*language.words, *language.held_out_words}):
            raise UserError(f"task.goal.language has words for {', '.join(clash)}, slots that goals fill: rename them")

    @property
    def name(self) -> str:
        """Name of the task in reports, such as "pick_place"."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", type(self).__name__).lower()

    def draw(self, random_state: np.random.RandomState) -> Goal:
        """Draw the goal of an episode."""
        return self

    @abstractmethod
    def subgoals(self, state: WorldState, referents: Referents) -> Sequence[Subgoal]:
        """Return the subgoals in order; the goal is reached while all are done."""

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """Return the arrangement after the goal is reached, or None if it cannot be reached from `arrangement`.

        A goal that does not define this takes no part in chains.
        """
        return None
