"""The toy world as a package of gymnasium would have it: registered on import, with what an expert needs in `info`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
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


class Twice(Toy):
    """The toy world, which tells its state in `info`, too."""

    def _info(self) -> dict[str, Any]:
        info = super()._info()
        own = info["truth"]["point"]
        return {**info, "state": own, "truth": {**info["truth"], "state": own}}


class Tensors(Toy):
    """The toy world, with tensors of PyTorch."""

    def _arrays(self, observation: Observation) -> dict[str, Any]:
        arrays = super()._arrays(observation)
        return {**arrays, **{name: torch.from_numpy(arrays[name]) for name in ("eye", "state")}}

    def _info(self) -> dict[str, Any]:
        info = super()._info()
        truth = {name: torch.from_numpy(np.array(value)) for name, value in info["truth"].items()}
        return {**info, "is_success": torch.tensor([info["is_success"]]), "truth": truth}


class Unbounded(Toy):
    """The toy world, which does not tell the bounds of its actions."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)


class Whole(Toy):
    """The toy world, whose actions are whole numbers, and one of two levels."""

    def __init__(self, render_mode: str | None = None, level: str = "easy") -> None:
        super().__init__(render_mode)
        self.level, self.taken = {"easy": 1, "hard": 2}[level], np.zeros(3, np.int64)
        self.action_space = gymnasium.spaces.Box(-2, 2, (3,), np.int64)

    def step(self, action: np.ndarray) -> Any:
        self.taken = action
        return super().step(action.astype(np.float32))


gymnasium.register("toy/Whole-v0", "toy_gym:Whole", max_episode_steps=500)
gymnasium.register("toy/Twice-v0", "toy_gym:Twice", max_episode_steps=500)
gymnasium.register("toy/Tensors-v0", "toy_gym:Tensors", max_episode_steps=500)
gymnasium.register("toy/Unbounded-v0", "toy_gym:Unbounded", max_episode_steps=500)
gymnasium.register("toy/Toy-v0", "toy_gym:Toy", max_episode_steps=500)
gymnasium.register("toy/Endless-v0", "toy_gym:Toy")
gymnasium.register("toy/Elsewhere-v0", "vla.envs.gym:Task")
