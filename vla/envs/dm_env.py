"""Tasks as dm_env environments: `vla.envs.dm_env.load("tabletop", goal="pick_place")`."""

from __future__ import annotations

from typing import Any

import dm_env
import numpy as np
from dm_env import TimeStep, specs

from vla.config.compose import make_task
from vla.spec import FIRST_SEED, Array, Environment, Observation


class DmEnvironment(dm_env.Environment):
    """Adapter of an `Environment` to dm_env.

    Observations are those of `vla.envs.gym.GymEnvironment`, with the `instruction` as a 0-d array of a string. The
    reward is 1 for the step that succeeds, else 0; the discount is 0 after success and failure, and 1 after a timeout.
    """

    def __init__(self, environment: Environment, random_state: int | np.random.RandomState | None = None) -> None:
        """Wrap an environment; `random_state` draws the seeds of episodes, which are below those of evaluation."""
        self.environment, self._episode_over = environment, True
        is_generator = isinstance(random_state, np.random.RandomState)
        self.random_state = random_state if is_generator else np.random.RandomState(random_state)

    def reset(self, seed: int | None = None) -> TimeStep:
        """Start the episode of `seed`, or of a random seed."""
        episode = int(self.random_state.randint(FIRST_SEED)) if seed is None else seed
        self._episode_over = False
        return dm_env.restart(_arrays(self.environment.reset(episode)))

    def step(self, action: Array) -> TimeStep:
        """Apply one (D,) action for one control period, or start a new episode after the last one ended."""
        if self._episode_over:
            return self.reset()
        observation = _arrays(self.environment.step(action))
        self._episode_over = self.environment.done
        outcome = self.environment.outcome
        if outcome == "success" or (self._episode_over and outcome == "failure"):
            return dm_env.termination(float(outcome == "success"), observation)
        return dm_env.truncation(0.0, observation) if self._episode_over else dm_env.transition(0.0, observation)

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


def _arrays(observation: Observation) -> dict[str, Array]:
    # Copies, because a world may reuse its arrays; contiguous for torch.
    images = {camera: np.array(image, order="C") for camera, image in observation.rgb.items()}
    state, instruction = np.array(observation.state, np.float32), np.array(observation.instruction, dtype=object)
    return {**images, "state": state, "instruction": instruction}
