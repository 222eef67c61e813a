"""A trained model as an agent: observations in, actions out."""

# T frames of history, k action chunk, D action components, K bins

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from torch import Tensor

from vla.models.model import Model
from vla.spec import Array, Observation, Spec

Batch = dict[str, Any]


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds of a policy."""

    path: Path
    config: dict[str, Any]  # the configuration that trained it
    spec: Spec
    state: dict[str, Tensor]  # of the model

    def restore(self, model: torch.nn.Module) -> None:
        """Load the weights.

        Raises:
            ValueError: they are those of another model.
        """
        try:
            model.load_state_dict(self.state)
        except RuntimeError as error:
            first = str(error).strip().splitlines()[-1].strip()
            raise ValueError(f"{self.path} does not fit the model of its own configuration: {first}") from error


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint without running code that may be in it.

    Raises:
        ValueError: there is no file, it is damaged, or it is not a checkpoint of this project.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}: give checkpoint=FILE, as in outputs/runs/…/checkpoints")
    try:
        # Old pickles, which torch would read too, fail in any way they like.
        with ZipFile(path) as archive:
            if archive.testzip() is not None:  # torch does not look at the checksums
                raise BadZipFile("checksums do not fit")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, UnpicklingError, OSError, BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as a checkpoint, it is damaged or something else") from error
    if not isinstance(content, dict) or not {"config", "spec", "state_dict"} <= set(content):
        raise ValueError(f"{path} is no checkpoint of this project: it carries no configuration and spec")
    prefix = "model."
    state = {key[len(prefix) :]: value for key, value in content["state_dict"].items() if key.startswith(prefix)}
    return Checkpoint(path, content["config"], Spec.from_dict(content["spec"]), state)


class Policy:
    """Acts with a model: keeps its history, executes of each chunk as many actions as the model says, one by one."""

    def __init__(self, model: Model, spec: Spec) -> None:
        """Args: the model, with its tokenizer; what a step looks like."""
        self.model, self.spec = model.eval(), spec
        self.info: dict[str, Any] = {}
        self._low, self._high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._frames: deque[dict[str, Tensor]] = deque(maxlen=model.history)
        self._chunk: deque[tuple[Array, dict[str, Any]]] = deque()
        self.reset("", 0)

    def reset(self, instruction: str, seed: int) -> None:
        """Forget the past; what the model draws from now on follows from `seed`."""
        self._random = torch.Generator().manual_seed(seed)
        self._frames.clear()
        self._chunk.clear()
        self._instruction = instruction
        self._text = self.model.text.tokenize([instruction])

    def act(self, observation: Observation) -> Array:
        """The (D,) float32 action to execute, within the spec's bounds; `info` may have its token probabilities (D, K).

        Raises:
            ValueError: the observation is not what the policy was trained on.
        """
        self._see(observation)
        if not self._chunk:
            actions, probabilities = self._predict()
            told = [{}] * len(actions) if probabilities is None else [{"probabilities": each} for each in probabilities]
            self._chunk.extend(list(zip(actions, told, strict=True))[: self.model.execute])
        action, self.info = self._chunk.popleft()
        return action

    def plan(self, observation: Observation) -> Array:
        """The (k, D) float32 actions of a whole chunk, within the spec's bounds, for those who time them themselves.

        Raises:
            ValueError: the observation is not what the policy was trained on.
        """
        self._see(observation)
        return self._predict()[0]

    def _see(self, observation: Observation) -> None:
        if observation.instruction != self._instruction:
            self.reset(observation.instruction, 0)
        self._frames.append(self._frame(observation))

    @torch.inference_mode()
    def _predict(self) -> tuple[Array, Array | None]:
        """Actions (k, D), clipped, and token probabilities (k, D, K), where the model has them."""
        noise = torch.randn(1, self.model.chunk, len(self.spec.action), generator=self._random)
        prediction = self.model.predict({**self.window(), "noise": noise})
        probabilities = None if prediction.probabilities is None else prediction.probabilities[0].numpy()
        return np.clip(prediction.actions[0].numpy(), self._low, self._high), probabilities

    def window(self) -> Batch:
        """What the model is given now: the frames seen so far, at most its history, as a batch of one."""
        joined = {name: torch.cat([frame[name] for frame in self._frames], 1) for name in self._frames[0]}
        rgb = {name: joined.pop(name) for name in self.spec.cameras if name in joined}
        return {**joined, "rgb": rgb, "text": self._text}

    @torch.inference_mode()
    def _frame(self, observation: Observation) -> dict[str, Tensor]:
        """One observation as tensors (1, 1, …): its tokens where the model can keep them, else all of it."""
        shape = (*self.spec.image_size, 3)
        seen = {camera: image.shape for camera, image in observation.rgb.items()}
        if any(seen.get(camera) != shape for camera in self.spec.cameras):
            raise ValueError(f"the policy looks through {self.spec.cameras} in {shape}, the observation has {seen}")
        proprio = np.concatenate([observation.joints, observation.velocities, [observation.gripper]])
        frame = {camera: torch.from_numpy(observation.rgb[camera].copy())[None, None] for camera in self.spec.cameras}
        frame["proprio"] = torch.from_numpy(proprio.astype(np.float32))[None, None]
        frame["present"] = torch.ones(1, 1, dtype=torch.bool)
        rgb = {camera: frame[camera] for camera in self.spec.cameras}
        tokens = self.model.encode({**frame, "rgb": rgb, "text": self._text})
        return frame if tokens is None else {"tokens": tokens, "present": frame["present"]}
