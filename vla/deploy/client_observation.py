"""Conversion of the messages of a policy server's clients to observations of the policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen

from vla.io.errors import UserError
from vla.io.types import Text
from vla.spec import LONGEST_INSTRUCTION, Array, Observation, RunningPlan, Spec

LARGEST_IMAGE = 4096  # pixels in a row or column


@dataclass(frozen=True)
class Keys:
    """Keys of a client's observation; a key that is absent is also looked up as a path of nested maps."""

    images: dict[str, Text]  # camera → key, by default its name; "picture": the whole of which some cameras show parts
    state: Annotated[list[Text], MinLen(1)]  # vectors to concatenate
    prompt: Text  # instruction

    def cameras(self, spec: Spec) -> dict[str, str]:
        """Return the cameras whose images are to be sent, with their keys."""
        return {camera: self.images.get(camera, camera) for camera in spec.required_images(self.images)}

    def observation(self, message: Any, spec: Spec) -> Observation:
        """Convert a client's observation, with images of any size; raise a UserError if it does not match the spec."""
        if not isinstance(message, Mapping):
            raise UserError(f"an observation must be a map, got {type(message).__name__}")
        cameras = self.cameras(spec)
        keys = [*cameras.values(), *self.state, self.prompt]
        values = {key: _find(message, key) for key in keys}
        if missing_keys := [key for key, value in values.items() if value is None]:
            names = ", ".join(str(key)[:50] for key in list(message)[:20])
            raise UserError(f"the observation lacks {', '.join(missing_keys)}: it has {names or 'nothing'}")
        images = {camera: _image(key, values[key]) for camera, key in cameras.items()}
        for camera, image in images.items():
            spec.require_cut(camera, image.shape, cameras[camera])
        state = np.concatenate([_vector(key, values[key]) for key in self.state])
        if len(state) != len(spec.state):
            raise UserError(
                f"the state in {' and '.join(self.state)} has {len(state)} numbers, "
                f"the policy needs {len(spec.state)}: {', '.join(spec.state)}"
            )
        prompt = instruction(self.prompt, values[self.prompt])
        return Observation(images, state, prompt, running=_running(message.get("running"), spec))


def _find(message: Mapping[Any, Any], key: str) -> Any:
    """Look up a key, or a path of nested maps such as observation/image."""
    if key in message:
        return message[key]
    value: Any = message
    for part in key.split("/"):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _image(key: str, value: Any) -> Array:
    """Return an image as (H, W, 3) uint8."""
    if not isinstance(value, np.ndarray) or value.ndim != 3 or 3 not in (value.shape[0], value.shape[2]):
        shape = getattr(value, "shape", type(value).__name__)
        raise UserError(f"{key} must be an image (H, W, 3) or (3, H, W), got {shape}")
    image = value if value.shape[2] == 3 else value.transpose(1, 2, 0)
    if not 1 <= min(image.shape[:2]) <= max(image.shape[:2]) <= LARGEST_IMAGE:
        raise UserError(f"{key} has {image.shape[1]} by {image.shape[0]} pixels, expected 1 to {LARGEST_IMAGE} each")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    if image.dtype.kind != "f" or not (np.min(image) >= 0 and np.max(image) <= 1):  # NaN fails both
        raise UserError(f"{key} is {image.dtype}: send uint8, or floats from 0 to 1")
    return np.ascontiguousarray(np.round(255 * image).astype(np.uint8))


def _vector(key: str, value: Any) -> Array:
    """Return numbers as (N,) float32."""
    try:
        array = np.asarray(value).reshape(-1)
        if array.dtype.kind not in "biuf":
            raise ValueError(array.dtype)
    except ValueError as error:  # also rows of different lengths
        raise UserError(f"{key} is not a vector of numbers") from error
    with np.errstate(over="ignore"):
        vector = array.astype(np.float32)
    if not np.isfinite(vector).all():
        raise UserError(f"{key} holds a number that is not finite")
    return vector


def _running(value: Any, spec: Spec) -> RunningPlan | None:
    """Return the rest of the plan that a client executes."""
    if value is None:
        return None
    plan, width = value if isinstance(value, Mapping) else {}, len(spec.action)
    actions, delay = plan.get("actions"), plan.get("delay")
    if not isinstance(actions, np.ndarray) or actions.ndim != 2 or actions.shape[1] != width or not len(actions):
        raise UserError(f"running/actions must be a plan (n, {width}), got {getattr(actions, 'shape', None)}")
    if type(delay) is not int or not 0 <= delay <= len(actions):
        raise UserError(f"running/delay is {repr(delay)[:50]}, expected an integer from 0 to {len(actions)}")
    return RunningPlan(_vector("running/actions", actions).reshape(actions.shape), delay)


def instruction(key: str, value: Any) -> str:
    """Return an instruction; raises a UserError if it is none."""
    if not isinstance(value, str):
        raise UserError(f"{key} must be an instruction, a text, got {type(value).__name__}")
    if len(value) > LONGEST_INSTRUCTION:
        raise UserError(f"{key} has {len(value)} characters, an instruction at most {LONGEST_INSTRUCTION}")
    return value
