"""What the robot is asked to do: an instruction, where the named block must go, and when that is reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vla.spec import Array


@dataclass(frozen=True)
class Progress:
    """The simulator's truth about the named block after a step."""

    block: Array  # (3,) its centre [m]
    start: Array  # (3,) its centre at the start of the episode [m]
    half_size: float  # [m]
    speed: float  # of its centre [m/s]
    held: bool  # both fingertips touch it
    touched: bool  # any fingertip touches it
    pad: Array  # (3,) centre of the target pad [m]


class Goal(Protocol):
    """One kind of task."""

    hold_steps: int  # control steps in a row for which `reached` must hold
    templates: tuple[str, ...]  # of the instruction; the slot {block} is the named block's colour
    releases: bool  # whether the block is let go at the destination

    def destination(self, progress: Progress) -> Array:
        """(3,) where the centre of the named block must go [m]."""
        ...

    def reached(self, progress: Progress) -> bool:
        """Whether the goal holds now."""
        ...


class PickPlace:
    """Put the named block on the pad and let go of it."""

    releases = True

    def __init__(
        self,
        radius: float = 0.04,
        hold_steps: int = 3,
        templates: Sequence[str] = (
            "put the {block} block on the pad",
            "place the {block} block on the pad",
            "move the {block} block onto the pad",
        ),
    ) -> None:
        """Args: how far from the pad's centre the block's centre may rest [m]; steps it must rest; instructions."""
        self.radius, self.hold_steps, self.templates = radius, hold_steps, tuple(templates)

    def destination(self, progress: Progress) -> Array:
        """On the pad's centre."""
        return np.array([*progress.pad[:2], progress.half_size])

    def reached(self, progress: Progress) -> bool:
        """On the pad, on the table, at rest and let go."""
        away = np.linalg.norm(progress.block[:2] - progress.pad[:2])
        resting = progress.block[2] < 1.5 * progress.half_size and progress.speed < 0.02
        return bool(away < self.radius and resting and not progress.touched)


class Lift:
    """Lift the named block and keep it up."""

    releases = False

    def __init__(
        self,
        height: float = 0.10,
        hold_steps: int = 3,
        templates: Sequence[str] = ("lift the {block} block", "pick up the {block} block", "raise the {block} block"),
    ) -> None:
        """Args: how high the block must be above where it stood [m]; steps it must stay there; instructions."""
        self.height, self.hold_steps, self.templates = height, hold_steps, tuple(templates)

    def destination(self, progress: Progress) -> Array:
        """Straight above where the block is, a little higher than asked."""
        return np.array([*progress.block[:2], progress.start[2] + self.height + 0.03])

    def reached(self, progress: Progress) -> bool:
        """High enough and held."""
        return bool(progress.held and progress.block[2] - progress.start[2] > self.height)
