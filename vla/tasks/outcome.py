"""Why an episode succeeded or failed, in one word."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla.spec import Array
from vla.tasks.goals import Progress

REACH = 0.035  # tool point to block centre at which a block counts as reached [m]
FALL = 0.05  # height of a block's centre above its rest from which losing it is a drop [m]
OUTCOMES = ("success", "never_reached", "missed_grasp", "wrong_object", "dropped", "not_placed", "timeout")


class Judge:
    """Watches an episode step by step and names its outcome.

    never_reached: the gripper never came near the named block. missed_grasp: it came near but never lifted it.
    wrong_object: it lifted another block and never the named one. dropped: it lost the named block in the air.
    not_placed: it let the block go, but not where it belongs. timeout: it still held the block at the end.
    """

    def __init__(self, hold_steps: int) -> None:
        """Args: control steps in a row for which the goal must hold."""
        self._hold_steps = hold_steps
        self._held_for = 0
        self._near = self._lifted = self._lifted_other = self._dropped = self._holding = False
        self._height = 0.0

    def watch(self, progress: Progress, reached: bool, tcp: Array, lifted: Sequence[bool], target: int) -> None:
        """Note one step: the truth, whether the goal holds, the tool point (3,), which blocks are in the air."""
        self._held_for = self._held_for + 1 if reached else 0
        self._near |= bool(np.linalg.norm(tcp - progress.block) < REACH)
        self._lifted_other |= any(up for index, up in enumerate(lifted) if index != target)
        if progress.held and lifted[target]:
            self._lifted = self._holding = True
            self._dropped = False
            self._height = progress.block[2] - progress.half_size
        elif self._holding and not progress.touched:
            self._holding = False
            self._dropped = self._height > FALL

    @property
    def success(self) -> bool:
        """Whether the goal held long enough."""
        return self._held_for >= self._hold_steps

    @property
    def outcome(self) -> str:
        """One of `OUTCOMES`."""
        if self.success:
            return "success"
        if not self._lifted:
            if self._lifted_other:
                return "wrong_object"
            return "missed_grasp" if self._near else "never_reached"
        if self._holding:
            return "timeout"
        return "dropped" if self._dropped else "not_placed"
