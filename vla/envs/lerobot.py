"""Conversion of observations to and from LeRobot's names. LeRobot itself is not needed.

LeRobot's state is the pose. Rates of change are separate, as `observation.velocities`, because LeRobot's policies use
all of the state as an input.

Shapes: B observations, P components of the state, H by W pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict

from vla.envs.gym import Task
from vla.io.errors import UserError
from vla.io.parts import PICTURE
from vla.spec import FIRST_SEED, Array, Observation, Spec

IMAGES, IMAGE = "observation.images.", "observation.image"  # prefix of cameras, and key of a single camera
STATE, RATES = "observation.state", "observation.velocities"
TASK = "task"  # the instructions
AGENT = {STATE: "agent_pos", RATES: "velocities"}  # what an environment calls them, before LeRobot renames them


class LeRobotEnvironment(Task):
    """A task of the config as an environment in which LeRobot evaluates policies.

    An observation has `pixels`, camera → (H, W, 3) uint8, `agent_pos`, the pose, and `velocities`, the rates of change,
    if the state has any, both float32. `info` has `is_success` only.
    """

    def __init__(self, task: str, longest: int, options: Mapping[str, Any]) -> None:
        """Build an option of the group `task` with `options`, see `vla.config.compose.compose_task`.

        LeRobot truncates an episode after `longest` steps.
        """
        super().__init__(task, "rgb_array", **options)
        self.vla_spec = self.environment.spec
        self._max_episode_steps = longest
        self.task_description = self.task = ""  # instruction and task of the episode
        image = Box(0, 255, (*self.vla_spec.image_size, 3), np.uint8)
        vectors = {AGENT[key]: Box(-np.inf, np.inf, (len(part),)) for key, part in _parts(self.vla_spec).items()}
        self.observation_space = Dict({"pixels": Dict(dict.fromkeys(self.vla_spec.cameras, image)), **vectors})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start the evaluation episode of `seed`, or of a drawn seed if it is None.

        To seeds of training, such as LeRobot's default ones, `FIRST_SEED` is added.
        """
        generator = self.np_random
        base_seed = int(generator.integers(FIRST_SEED)) if seed is None else seed
        result = super().reset(seed=base_seed + FIRST_SEED * (base_seed < FIRST_SEED), options=options)
        if seed is None:  # else the next seed would follow from this one, and soon the same ones would come again
            self.np_random = generator
        return result

    def _arrays(self, observation: Observation) -> dict[str, Any]:
        values = super()._arrays(observation)
        self.task_description, self.task = observation.instruction, self.environment.task
        vectors = {AGENT[key]: values["state"][part] for key, part in _parts(self.vla_spec).items()}
        return {"pixels": {camera: values[camera] for camera in self.vla_spec.cameras}, **vectors}

    def _info(self) -> dict[str, Any]:
        return {"is_success": self.environment.outcome == "success"}


def arrays(observation: Observation, spec: Spec) -> dict[str, Array]:
    """Convert an observation to a step as in LeRobot's datasets: float32, images (3, H, W) from 0 to 1."""
    images = {
        f"{IMAGES}{name}": np.ascontiguousarray(observation.rgb[name].transpose(2, 0, 1)) / np.float32(255)
        for name in spec.cameras
    }
    return {**images, **{key: observation.state[indices] for key, indices in _parts(spec).items()}}


def observations(batch: Mapping[str, Any], spec: Spec) -> list[Observation]:
    """Convert a LeRobot batch to observations.

    Args:
        batch: `observation.images.CAMERA` (B, 3, H, W) from 0 to 1, or `observation.image`, that of the only camera or
            the whole picture of which cameras show parts; `observation.state` and `observation.velocities` (B, …)
            arrays, and `task`, B instructions.
        spec: of the policy.

    Raises:
        UserError: an entry is missing or has another shape.
    """
    parts = _parts(spec)
    image_names = spec.required_images([PICTURE] if IMAGE in batch else [])
    sole_image = image_names if IMAGE in batch and len(image_names) == 1 else []  # the only image of batch and policy
    keys = {name: IMAGE if name in (PICTURE, *sole_image) else f"{IMAGES}{name}" for name in image_names}
    entries = [*keys.values(), *parts, TASK]
    if missing_keys := [key for key in entries if key not in batch]:
        raise UserError(f"the policy needs {', '.join(missing_keys)}, but the batch has {', '.join(map(str, batch))}")
    count = len(batch[STATE])
    state = np.zeros((count, len(spec.state)), np.float32)
    for key, indices in parts.items():
        if batch[key].shape != (count, len(indices)):
            names = ", ".join(spec.state[index] for index in indices)
            raise UserError(f"{key} must be ({count}, {len(indices)}): {names}; it is {batch[key].shape}")
        state[:, indices] = batch[key]
    images = {camera: _pixels(batch[key]) for camera, key in keys.items()}
    instructions: Sequence[str] = batch[TASK]
    return [
        Observation({camera: image[row] for camera, image in images.items()}, state[row], instructions[row])
        for row in range(count)
    ]


def _parts(spec: Spec) -> dict[str, list[int]]:
    """Return key of a vector → indices of its components in the state."""
    return {STATE: spec.pose, **({RATES: spec.rates} if spec.rates else {})}


def _pixels(images: Array) -> Array:
    """Convert (B, 3, H, W) from 0 to 1 to (B, H, W, 3) uint8, exactly if they are bytes divided by 255."""
    return np.ascontiguousarray(np.round(255 * images).clip(0, 255).astype(np.uint8).transpose(0, 2, 3, 1))
