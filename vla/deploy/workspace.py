"""Box that the tool point does not leave, whatever the joints do on their way between two goals."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vla.deploy.joint_limiter import JointLimiter
from vla.spec import Array

LEEWAY = 0.005  # by which the tool may leave the box [m]: joints do not move it along a straight line


@dataclass(frozen=True, eq=False)
class Workspace:
    """Takes steps after which the arm can still stop inside the box."""

    forward: Callable[[Array], tuple[Array, Array]]  # as in `Kinematics`
    low: Array  # corners (3,) in the base frame [m]
    high: Array

    def step(self, limiter: JointLimiter, goal: Array, remaining: float) -> None:
        """Let `limiter` take a step towards a goal, see there, or brake if it could not stop inside after that step.

        A tool that is outside may come back, but not move further away.
        """
        ahead = copy.copy(limiter)
        ahead.step(goal, remaining)
        position, velocity = ahead.position, ahead.velocity
        farthest = max(LEEWAY, self._outside(limiter.position))
        while self._outside(ahead.position) <= farthest:
            if ahead.resting:
                limiter.position, limiter.velocity = position, velocity
                return
            ahead.brake()
        limiter.brake()

    def _outside(self, joints: Array) -> float:
        """Return the distance [m] along an axis by which the tool is outside of the box; 0 or less inside."""
        tool = self.forward(joints)[0][:3, 3]
        return float(np.max([self.low - tool, tool - self.high]))
