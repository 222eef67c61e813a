"""A mixture of goals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vla.io.errors import UserError
from vla.io.types import Share
from vla.tasks.tabletop.goals.goal import Goal
from vla.tasks.tabletop.goals.stay import Stay, Wait, absent_colours_needed


class Mixed:
    """A mixture of goals, one drawn per episode; `blocks` and `absent` are the maxima over the goals.

    In a share of the episodes the instruction of the drawn goal names a block that is not on the table, and in another
    share there is none: the robot must then leave everything in place.
    """

    def __init__(self, goals: Mapping[str, Goal | None], impossible: Share, silent: Share) -> None:
        """Args: name → goal, or None to omit it; share of the episodes with an absent block; share of those with an
        empty instruction.

        Raises:
            UserError: no goal remains, or the shares exceed one.
        """
        self.goals = {name: goal for name, goal in goals.items() if goal is not None}
        if not self.goals:
            raise UserError("task.goal.goals names no goal")
        if impossible + silent > 1:
            raise UserError(f"task.goal.impossible and task.goal.silent are {impossible + silent:g} in all, at most 1")
        self.impossible, self.silent = impossible, silent
        self.blocks = max(goal.blocks for goal in self.goals.values())
        kept = [absent_colours_needed(goal.language) for goal in self.goals.values() if impossible]
        self.absent = max([goal.absent for goal in self.goals.values()] + kept)

    def draw(self, random_state: np.random.RandomState) -> Goal:
        """Draw a goal, then whether to replace it by `Stay` or `Wait`; the drawn goal does not depend on the shares."""
        goal = self.goals[str(random_state.choice(list(self.goals)))]
        lot = random_state.uniform()
        if lot < self.impossible:
            return Stay.instead_of(goal)
        return Wait(goal.pads) if lot < self.impossible + self.silent else goal
