"""Tasks as dm_env environments: `vla.envs.dm_env.load("tabletop", goal="pick_place")`."""

from __future__ import annotations

from typing import Any

import dm_env
import numpy as np
from dm_env import TimeStep, specs

from vla.config.compose import make_task
from vla.envs.gym import GymEnvironment
from vla.spec import FIRST_SEED, Array, Environment


class DmEnvironment(dm_env.Environment):
    """Adapter of an `Environment` to dm_env.

    Observations are those of `vla.envs.gym.GymEnvironment`, with the `instruction` as a 0-d array of a string. The
    reward is 1 for the step that succeeds, else 0; the discount is 0 after success and failure, and 1 after a timeout.
    """

    def __init__(self, environment: Environment, random_state: int | np.random.RandomState | None = None) -> None:
        """Wrap an environment; `random_state` draws the seeds of episodes, which are below those of evaluation."""
        self.environment, self._adapted, self._episode_over = environment, GymEnvironment(environment), True
        is_generator = isinstance(random_state, np.random.RandomState)
        self.random_state = random_state if is_generator else np.random.RandomState(random_state)

    def reset(self, seed: int | None = None) -> TimeStep:
        """Start the episode of `seed`, or of a random seed."""
        self._episode_over = False
        episode = int(self.random_state.randint(FIRST_SEED)) if seed is None else seed
        return dm_env.restart(_with_array(self._adapted.reset(seed=episode)[0]))

    def step(self, action: Array) -> TimeStep:
        """Apply one (D,) action for one control period, or start a new episode after the last one ended."""
        if self._episode_over:
            return self.reset()
        values, reward, terminated, truncated, _ = self._adapted.step(action)
        self._episode_over = terminated or truncated
        if terminated:
            return dm_env.termination(reward, _with_array(values))
        return (dm_env.truncation if truncated else dm_env.transition)(0.0, _with_array(values))

    def observation_spec(self) -> dict[str, specs.Array]:
        """Return the shapes and dtypes of an observation."""
        spec = self.environment.spec
        return {
            **{camera: specs.BoundedArray((*spec.image_size, 3), np.uint8, 0, 255, camera) for camera in spec.cameras},
            "state": specs.Array((len(spec.state),), np.float32, "\t".join(spec.state)),
            "instruction": specs.StringArray((), name="instruction"),
        }

    def action_spec(self) -> specs.BoundedArray:
        """Return the bounds of an action."""
        spec = self.environment.spec
        low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        return specs.BoundedArray(low.shape, np.float32, low, high, "\t".join(spec.action))

    def close(self) -> None:
        """Close the environment."""
        self.environment.close()


def load(task: str, random_state: int | np.random.RandomState | None = None, **overrides: Any) -> DmEnvironment:
    """Build a task of the config as a dm_env environment; see `vla.config.compose.compose_task`."""
    return DmEnvironment(make_task(task, **overrides), random_state)


def _with_array(values: dict[str, Any]) -> dict[str, Array]:
    return {**values, "instruction": np.array(values["instruction"], dtype=object)}
