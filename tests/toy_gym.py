"""The toy world as a package of gymnasium would have it: registered on import, with what an expert needs in `info`."""

from __future__ import annotations

from typing import Any

import gymnasium
from toy import ToyEnvironment

from vla.envs.gym import GymEnvironment
from vla.spec import Observation


class Toy(GymEnvironment):
    """The toy world, and in `info` its truth."""

    def __init__(self, render_mode: str | None = None, seconds_per_step: float = 0.0) -> None:
        super().__init__(ToyEnvironment(seconds_per_step), render_mode)

    def _arrays(self, observation: Observation) -> dict[str, Any]:
        self._truth = observation.truth
        return super()._arrays(observation)

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "truth": self._truth}


gymnasium.register("toy/Toy-v0", "toy_gym:Toy", max_episode_steps=500)
gymnasium.register("toy/Endless-v0", "toy_gym:Toy")
gymnasium.register("toy/Elsewhere-v0", "vla.envs.gym:Task")
