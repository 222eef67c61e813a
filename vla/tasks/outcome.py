"""Why an episode succeeded or failed, in one word."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla.tasks.goals.goal import Facts, Manner, Subgoal

REACH = 0.035  # tool point to block centre at which a block counts as reached [m]
PUSH = 0.07  # the same where it is to be pushed, from beside it [m]
CLEAR = 0.02  # height above its rest at which a held block counts as lifted [m]
FALL = 0.05  # height of a block's centre above its rest from which losing it is a drop [m]
OUTCOMES = (
    *("success", "never_reached", "missed_grasp", "wrong_object", "dropped", "not_placed", "timeout"),
    "did_not_stay",
)


class Judge:
    """Watches an episode step by step and names its outcome.

    Where several blocks are named, it is about the one whose turn it is. never_reached: the gripper never came near the
    named block. missed_grasp: it came near but never lifted it. wrong_object: it lifted another block and never the
    named one. dropped: it lost the named block in the air. not_placed: it let the block go, or pushed it, but not where
    it belongs. timeout: it still held the block at the end. did_not_stay: it should have left everything as it was, and
    did something.
    """

    def __init__(self, hold_steps: int) -> None:
        """Args: control steps in a row for which the goal must hold."""
        self._hold_steps = hold_steps
        self._held_for = 0
        self._near = self._lifted = self._lifted_other = self._dropped = self._holding = False
        self._manner: Manner | None = None
        self._height, self._block = 0.0, -1

    def watch(self, facts: Facts, subgoals: Sequence[Subgoal], named: Sequence[int]) -> None:
        """Note one step: the truth, what has to be done, which blocks the instruction names."""
        self._held_for = self._held_for + 1 if all(subgoal.done for subgoal in subgoals) else 0
        now = next((subgoal for subgoal in subgoals if not subgoal.done), subgoals[-1])
        block, self._manner = now.block, now.manner
        if block != self._block:
            self._block, self._near, self._lifted, self._holding, self._dropped = block, False, False, False, False
        self._near |= bool(
            np.linalg.norm(facts.tool - facts.positions[block]) < (PUSH if now.manner == "push" else REACH)
        )
        lifted = facts.held & (facts.positions[:, 2] > facts.extents[:, 2] + CLEAR)
        self._lifted_other |= any(up for index, up in enumerate(lifted) if index not in named)
        if lifted[block]:
            self._lifted = self._holding = True
            self._dropped = False
            self._height = facts.positions[block, 2] - facts.extents[block, 2]
        elif self._holding and not facts.touched[block]:
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
        if self._manner == "stay":
            return "did_not_stay"
        if not self._lifted:
            if self._lifted_other:
                return "wrong_object"
            if self._manner == "push" and self._near:
                return "not_placed"
            return "missed_grasp" if self._near else "never_reached"
        if self._holding:
            return "timeout"
        return "dropped" if self._dropped else "not_placed"
