"""Tasks as gymnasium environments."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium.error import CustomSpaceError
from gymnasium.spaces import Box, Dict, Text
from gymnasium.vector.utils import create_shared_memory

from vla.config.compose import make_task
from vla.io.errors import UserError
from vla.spec import FIRST_SEED, LONGEST_INSTRUCTION, Array, Environment, Observation

UNBOUNDED = np.finfo(np.float32).max
LETTERS = "".join(filter(str.isprintable, map(chr, range(0x10000))))  # of an instruction in most languages


class Sentence(Text):
    """Space of instructions; its `repr` omits the 60 000 characters that they may contain."""

    def __init__(self) -> None:
        super().__init__(LONGEST_INSTRUCTION, min_length=0, charset=LETTERS)

    def __repr__(self) -> str:
        return f"Text({self.min_length}, {self.max_length})"


@create_shared_memory.register(Sentence)
def _refuse_shared_memory(space: Sentence, n: int = 1, ctx: Any = None) -> NoReturn:
    """Make AsyncVectorEnv raise: of a text in shared memory it returns for ever what it reads before the first episode.

    Its error says that shared_memory=False is the way out.
    """
    raise CustomSpaceError("instructions cannot be shared")


class GymEnvironment(gymnasium.Env[dict[str, Any], Array]):
    """Adapter of an `Environment` to gymnasium.

    An observation is a dictionary: one image per camera, (H, W, 3) uint8, the `state` (P,) float32 and the
    `instruction`. The reward is 1 for the step that succeeds, otherwise 0. Success and failure terminate an episode,
    its time limit truncates it. `info` contains `is_success`, the current outcome and the draws of the episode.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, environment: Environment, render_mode: str | None = None) -> None:
        """Wrap an environment; with "rgb_array", `render` returns the images of all cameras side by side.

        Raises a UserError for another mode.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"render_mode={render_mode!r} is none of the modes: give rgb_array or None")
        self.environment, self.render_mode = environment, render_mode
        spec = environment.spec
        self.metadata = {**self.metadata, "render_fps": round(spec.control_hz)}
        self.observation_space = Dict(
            {
                **{camera: Box(0, 255, (*spec.image_size, 3), np.uint8) for camera in spec.cameras},
                "state": Box(-UNBOUNDED, UNBOUNDED, (len(spec.state),), np.float32),
                "instruction": Sentence(),
            }
        )
        self.action_space = Box(np.array(spec.low, np.float32), np.array(spec.high, np.float32), dtype=np.float32)
        self._images: list[Array] = []
        self._closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start the episode of `seed`; without a seed, draw one below those of evaluation."""
        super().reset(seed=seed)
        episode = int(self.np_random.integers(FIRST_SEED)) if seed is None else seed
        return self._arrays(self.environment.reset(episode)), self._info()

    def step(self, action: Array) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply one (D,) action for one control period."""
        observation = self._arrays(self.environment.step(action))
        outcome, done = self.environment.outcome, self.environment.done
        terminated = outcome == "success" or (done and outcome == "failure")  # a time limit truncates instead
        return observation, float(outcome == "success"), terminated, done and not terminated, self._info()

    def render(self) -> Array | None:
        """Return the newest images side by side, (H, C·W, 3) uint8."""
        return np.concatenate(self._images, axis=1) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the environment."""
        if not self._closed:
            self.environment.close()
        self._closed = True

    def _arrays(self, observation: Observation) -> dict[str, Any]:
        # Copies, because a world may reuse its arrays; contiguous for torch.
        images = {camera: np.array(image, order="C") for camera, image in observation.rgb.items()}
        self._images = list(images.values())
        return {**images, "state": np.array(observation.state, np.float32), "instruction": observation.instruction}

    def _info(self) -> dict[str, Any]:
        outcome = self.environment.outcome
        return {"is_success": outcome == "success", "outcome": outcome, "draws": deepcopy(self.environment.draws)}


class Task(GymEnvironment):
    """A task of the config as a gymnasium environment."""

    def __init__(self, task: str, render_mode: str | None = None, **overrides: Any) -> None:
        """Build an option of the group `task`; see `vla.config.compose.compose_task` and `GymEnvironment`."""
        super().__init__(make_task(task, **overrides), render_mode)
