"""A mixture of goals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vla.tasks.tabletop.goals.goal import Goal


class Mixed:
    """A mixture of goals, one drawn per episode; `blocks` and `absent` are the maxima over the goals."""

    def __init__(self, goals: Mapping[str, Goal | None]) -> None:
        """Args: name → goal, or None to omit it.

        Raises:
            ValueError: no goal remains.
        """
        self.goals = {name: goal for name, goal in goals.items() if goal is not None}
        if not self.goals:
            raise ValueError("task.goal.goals names no goal")
        self.blocks = max(goal.blocks for goal in self.goals.values())
        self.absent = max(goal.absent for goal in self.goals.values())

    def draw(self, random_state: np.random.RandomState) -> Goal:
        """Draw one of the goals."""
        return self.goals[str(random_state.choice(list(self.goals)))]
