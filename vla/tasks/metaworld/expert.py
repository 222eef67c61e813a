"""The scripted experts that come with Meta-World."""

from __future__ import annotations

from typing import Any

import numpy as np
from metaworld.policies import ENV_POLICY_MAP

from vla.io.errors import UserError
from vla.spec import Array, Observation, Spec
from vla.tasks.metaworld.environment import REACH, STATE
from vla.tasks.metaworld.package import VERSION, tasks_of
from vla.tasks.world import action_of


class Scripted:
    """Meta-World's expert for the current task: a function of the simulator's observation, clipped to the bounds."""

    looks = False
    memoryless = True  # of all fifty experts of Meta-World 3.0.0

    def __init__(self, *, spec: Spec) -> None:
        """Act in an environment of this spec; a UserError if it is not that of Meta-World."""
        if spec.state != STATE:
            raise UserError("expert=metaworld acts in task=metaworld only: choose the expert of this task")
        self.info: dict[str, Any] = {}
        self._names = tasks_of("mt50")
        self._expert: Any = None

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode, with a new expert for its task, in case experts have a state."""
        self._expert = None

    def act(self, observation: Observation) -> Array:
        """Return the (4,) float32 action of the expert (UserError: the observation lacks the simulator's truth)."""
        truth = observation.require_truth("expert=metaworld")
        if self._expert is None:
            self._expert = ENV_POLICY_MAP[self._names[int(truth["task"][0])] + VERSION]()
        return action_of(np.asarray(self._expert.get_action(truth["observation"])), REACH)
