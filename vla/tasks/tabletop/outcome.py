"""Classification of an episode's success or failure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla.tasks.tabletop.goals.goal import Skill, Subgoal, WorldState, current_subgoal

REACH = 0.035  # distance between tool point and block centre at which a block is reached [m]
PUSH = 0.07  # the same for a block to be pushed from its side [m]
CLEAR = 0.02  # height above the table at which a held block is lifted [m]
FALL = 0.05  # height above the table, or a block below, from which losing a block is a drop [m]
# Outcomes of episodes in which the named block was grasped, or reached if it is to be pushed.
GRASPED = ("success", "dropped", "not_placed", "timeout")


class OutcomeClassifier:
    """Classifier of an episode's outcome, updated at every step.

    With several named blocks, the outcome refers to the block of the current subgoal.

    - never_reached: the gripper never came near the block.
    - missed_grasp: the gripper came near the block and never lifted it.
    - wrong_object: the gripper lifted a block that is not named, and never this one.
    - dropped: the gripper lost the block in the air.
    - not_placed: the block was released or pushed, but not at its destination.
    - timeout: the gripper still held the block at the end.
    - did_not_stay: the robot acted although it had to leave everything in place.
    """

    def __init__(self, hold_steps: int) -> None:
        """Take the number of consecutive control steps for which the goal must hold."""
        self._hold_steps, self._held_for = hold_steps, 0
        self._near = self._lifted = self._lifted_other = self._dropped = self._holding = False
        self._skill: Skill | None = None
        self._height, self._block = 0.0, -1

    def update(self, state: WorldState, subgoals: Sequence[Subgoal], named: Sequence[int]) -> None:
        """Update with one step: its state, its subgoals, the indices of the named blocks."""
        self._held_for = self._held_for + 1 if all(subgoal.done for subgoal in subgoals) else 0
        subgoal = current_subgoal(subgoals)
        block, self._skill = subgoal.block, subgoal.skill
        if block != self._block:
            self._block, self._near, self._lifted, self._holding, self._dropped = block, False, False, False, False
        reach = PUSH if subgoal.skill == "push" else REACH
        self._near |= bool(np.linalg.norm(state.tool - state.positions[block]) < reach)
        lifted = state.held & (state.positions[:, 2] > state.extents[:, 2] + CLEAR)
        self._lifted_other |= any(is_lifted for index, is_lifted in enumerate(lifted) if index not in named)
        if lifted[block]:
            self._lifted = self._holding = True
            self._dropped = False
            self._height = _height(state, block)
        elif self._holding and not state.touched[block]:
            self._holding, self._dropped = False, self._height > FALL

    @property
    def success(self) -> bool:
        """True if the goal held for `hold_steps`."""
        return self._held_for >= self._hold_steps

    @property
    def outcome(self) -> str:
        """Success, or the name of the failure so far."""
        if self.success:
            return "success"
        if self._skill == "stay":
            return "did_not_stay"
        if self._lifted:
            return "timeout" if self._holding else "dropped" if self._dropped else "not_placed"
        if self._lifted_other:
            return "wrong_object"
        if self._skill == "push" and self._near:
            return "not_placed"
        return "missed_grasp" if self._near else "never_reached"

    @property
    def milestones(self) -> frozenset[str]:
        """ "grasped" after the block was lifted, or "reached" after the tool came near a block to be pushed; empty for
        "stay"."""
        if self._skill in (None, "stay") or self.outcome not in GRASPED:
            return frozenset()
        return frozenset({"reached" if self._skill == "push" else "grasped"})


def _height(state: WorldState, block: int) -> float:
    """Return the height of a block above the table, or above another block that its centre is over [m]."""
    bottom, tops = state.positions[block, 2] - state.extents[block, 2], state.positions[:, 2] + state.extents[:, 2]
    apart = np.abs(state.positions[:, :2] - state.positions[block, :2]).max(axis=1)
    below = (apart < state.extents[:, :2].max(axis=1)) & (tops < state.positions[block, 2])
    return float(bottom - tops[below].max(initial=0.0))
