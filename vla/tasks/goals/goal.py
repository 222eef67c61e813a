"""What a goal is: whom it is about, in which words it is asked for, and which subgoals lead there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vla.spec import Array
from vla.tasks.language import Grammar

AT_REST = 0.02  # speed below which a block counts as resting [m/s]

Manner = Literal["place", "hold", "push", "stay"]
MANNERS: tuple[Manner, ...] = ("place", "hold", "push", "stay")


@dataclass(frozen=True)
class Facts:
    """The simulator's truth after a step; B blocks on the table, Z pads."""

    positions: Array  # (B, 3) centres of the blocks [m]
    starts: Array  # (B, 3) the same when the episode began [m]
    extents: Array  # (B, 3) half sizes, upright [m]
    speeds: Array  # (B,) of the centres [m/s]
    lifts: Array  # (B,) the furthest that each has been above where it stood [m]
    held: Array  # (B,) whether both fingertips touch it
    touched: Array  # (B,) whether any does
    pads: Array  # (Z, 3) centres [m]
    tool: Array  # (3,) the point between the fingertips [m]
    arm_speed: float = 0.0  # of the fastest joint [rad/s]

    def away(self, block: int, place: Array) -> float:
        """Horizontal distance of a block's centre from a place [m]."""
        return float(np.hypot(*(self.positions[block] - place)[:2]))

    def resting(self, block: int) -> bool:
        """Whether a block stands or lies still on the table, and nobody holds it."""
        low = self.positions[block, 2] < 1.5 * self.extents[block].max()
        return bool(low and self.speeds[block] < AT_REST and not self.touched[block])

    def on_table(self, block: int, place: Array) -> Array:
        """(3,) where the centre of a block is that stands on the table at a place [m]."""
        return np.array([place[0], place[1], self.extents[block, 2]])


@dataclass(frozen=True)
class Aim:
    """Whom an episode is about, in the order in which they are named."""

    blocks: tuple[int, ...]
    pads: tuple[int, ...]


@dataclass(frozen=True)
class Subgoal:
    """One thing to do with one block."""

    block: int
    destination: Array  # (3,) for its centre [m]
    manner: Manner  # let go there, keep there, get there without being lifted, or leave it alone
    done: bool
    tolerance: float = 0.02  # horizontal distance from the destination at which to let go [m]


class Goal(ABC):
    """One kind of task.

    Attributes:
        named: how many blocks the instruction names.
        moves: how many of them are to be moved.
        blocks: the fewest that must lie on the table.
        absent: the fewest colours that must not lie there.
        pads: how many lie there.
        language: what is said; the slots {block} and {other} are the named blocks' colours, {absent} one that no
            block has, {pad} and {rest} those of the pads.
        hold_steps: control steps in a row for which all subgoals must be done.
    """

    named, moves, blocks, absent, pads = 1, 1, 2, 0, 1

    def __init__(self, language: Grammar, hold_steps: int) -> None:
        known = ["block", "other"][: self.named] + ["pad", "rest"][: self.pads] + ["absent"] * bool(self.absent)
        if unknown := sorted(language.slots - set(known)):
            raise ValueError(f"task.goal.language has the slots {unknown}, but {type(self).__name__} fills {known}")
        self.language, self.hold_steps = language, hold_steps

    def draw(self, random_state: np.random.RandomState) -> Goal:
        """The goal of an episode."""
        return self

    @abstractmethod
    def subgoals(self, facts: Facts, aim: Aim) -> Sequence[Subgoal]:
        """What must be done, in order; the goal is reached while all is."""


def placed(facts: Facts, block: int, pad: int, radius: float) -> bool:
    """Whether a block rests on a pad, let go."""
    return facts.away(block, facts.pads[pad]) < radius and facts.resting(block)
