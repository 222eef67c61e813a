"""A trained model as an agent: observations in, actions out."""

# k action chunk, D action components, K bins

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from vla.models.compile_cache import set_compile_cache
from vla.models.model import Batch, Model
from vla.spec import LONGEST_INSTRUCTION, Array, Observation, Spec

LONG_SENTENCE = " ".join(["sentence"] * 24)  # shorter instructions are padded to it for a constant shape


class Policy:
    """An agent around a model: caches encoded frames of the history, and executes the first actions of each chunk.

    Args:
        device: "auto" is a GPU if there is one.
        precision: "fp32", or "bf16" for matrix products in bfloat16.
        compile: compile the model, which takes up to a minute at the first action and needs g++ on a CPU. On a GPU
            CUDA graphs are used. Weights stay inputs of the graphs, so that models of one class share them.
        model: the network, with its tokenizer.
        spec: observation and action spaces.

    Raises:
        ValueError: device="cuda" without a GPU.
    """

    def __init__(
        self,
        device: Literal["auto", "cpu", "cuda"],
        precision: Literal["fp32", "bf16"],
        compile: bool,
        *,
        model: Model,
        spec: Spec,
    ) -> None:
        if device == "cuda" and not torch.cuda.is_available():
            raise ValueError("policy.device=cuda, but PyTorch finds no GPU here: policy.device=auto uses the CPU")
        available = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(available if device == "auto" else device)
        self.model, self.spec = model.eval().to(self.device), spec
        self.execute = model.execute  # number of actions of a chunk to execute
        self.history = model.history  # number of frames it looks at; with several it wants to see every one
        self.info: dict[str, Any] = {}
        self.one_at_a_time = compile  # plans for one observation per pass
        self._bf16 = precision == "bf16"
        self._encode, self._predict_chunk = self.model.encode, self.model.predict
        self._padding_sentences = [LONG_SENTENCE] if compile else []
        if compile:
            set_compile_cache()
            mode = "reduce-overhead" if self.device.type == "cuda" else None
            self._encode = torch.compile(self.model.encode, mode=mode)
            self._predict_chunk = torch.compile(self.model.predict, mode=mode)
        self._low, self._high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._frames: deque[dict[str, Tensor]] = deque(maxlen=model.history)
        self._chunk: deque[tuple[Array, dict[str, Any]]] = deque()
        self.reset("", 0)

    def reset(self, instruction: str, seed: int) -> None:
        """Clear the history, and seed the noise of the model.

        Raises:
            ValueError: the instruction has more than `LONGEST_INSTRUCTION` characters.
        """
        if len(instruction) > LONGEST_INSTRUCTION:
            raise ValueError(f"an instruction has at most {LONGEST_INSTRUCTION} characters, not {len(instruction)}")
        self._random = torch.Generator().manual_seed(seed)
        self._frames.clear()
        self._chunk.clear()
        self._instruction = instruction
        self._text = self.model.text.tokenize([instruction, *self._padding_sentences])[:1].to(self.device)

    def act(self, observation: Observation | Mapping[str, Any]) -> Array:
        """Return the action to execute, (D,) float32, clipped to the spec; `info` may have token probabilities (D, K).

        An observation may also be that of `vla.api.load_environment`.

        Raises:
            ValueError: the observation does not match the spec.
        """
        if not isinstance(observation, Observation):
            observation = Observation.from_mapping(observation, self.spec)
        self._follow(observation.instruction)
        if self.looks:
            self._observe(observation)
        if not self._chunk:
            actions, probabilities = self._predict()
            infos = [{}] * len(actions) if probabilities is None else [{"probabilities": p} for p in probabilities]
            self._chunk.extend(list(zip(actions, infos, strict=True))[: self.execute])
        action, self.info = self._chunk.popleft()
        return action

    @property
    def looks(self) -> bool:
        """Whether the next action is not chosen yet, or its observation is part of a history."""
        return not self._chunk or self.model.history > 1

    def plan(self, observation: Observation) -> Array:
        """Return a chunk of actions, (k, D) float32, clipped to the spec; the caller executes the first `execute`.

        Raises:
            ValueError: the observation does not match the spec.
        """
        self._observe(observation)
        return self._predict()[0]

    def session(self) -> Policy:
        """Return another agent with the same model and a history of its own."""
        other = copy(self)
        other._frames, other._chunk = deque(maxlen=self.model.history), deque()
        other.reset("", 0)
        return other

    def _observe(self, observation: Observation) -> None:
        self._follow(observation.instruction)
        self._frames.append(self._encoded(self.frame(observation)))

    def _follow(self, instruction: str) -> None:
        if instruction != self._instruction:
            self.reset(instruction, 0)

    def _predict(self) -> tuple[Array, Array | None]:
        """Return clipped actions, (k, D), and token probabilities, (k, D, K), if the model has them."""
        actions, probabilities = self._predicted(self._inputs())
        return actions[0], None if probabilities is None else probabilities[0]

    def _inputs(self) -> Batch:
        """Return the input of one prediction, with the next noise if the model needs any."""
        noise = self.model.sample_noise(self._random)
        return self.window() if noise is None else {**self.window(), "noise": noise.to(self.device)}

    @torch.inference_mode()
    def _predicted(self, inputs: Batch) -> tuple[Array, Array | None]:
        """Return clipped actions, (B, k, D), and token probabilities, (B, k, D, K), if the model has them."""
        with self._autocast():
            actions, probabilities = self._predict_chunk(inputs)
        array = None if probabilities is None else probabilities.float().cpu().numpy()
        return np.clip(actions.float().cpu().numpy(), self._low, self._high), array

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16)

    def window(self) -> Batch:
        """Return the current model input, a batch of one: the frames so far, padded to the history of the model."""
        padding = {name: torch.zeros_like(values) for name, values in self._frames[0].items()}
        frames = [*self._frames, *[padding] * (self.model.history - len(self._frames))]
        joined = {name: torch.cat([frame[name] for frame in frames], 1) for name in padding}
        rgb = {name: joined.pop(name) for name in self.spec.cameras if name in joined}
        return {**joined, "rgb": rgb, "text": self._text}

    def frame(self, observation: Observation) -> Batch:
        """Convert an observation to a batch of one frame.

        Raises:
            ValueError: the observation does not match the spec.
        """
        shape = (*self.spec.image_size, 3)
        shapes = {camera: image.shape for camera, image in observation.rgb.items()}
        if any(shapes.get(camera) != shape for camera in self.spec.cameras):
            raise ValueError(f"the policy needs cameras {self.spec.cameras} of {shape}, the observation has {shapes}")
        if other := [camera for camera in self.spec.cameras if observation.rgb[camera].dtype != np.uint8]:
            raise ValueError(f"images must be uint8, 0 to 255, that of {other[0]} is {observation.rgb[other[0]].dtype}")
        if observation.state.shape != (len(self.spec.state),):
            raise ValueError(f"the policy's state is {self.spec.state}, the observation's {observation.state.shape}")
        return {
            "rgb": {camera: self._tensor(observation.rgb[camera]) for camera in self.spec.cameras},
            "state": self._tensor(np.asarray(observation.state, np.float32)),
            "present": torch.ones(1, 1, dtype=torch.bool, device=self.device),
            "text": self._text,
        }

    @torch.inference_mode()
    def _encoded(self, frame: Batch) -> dict[str, Tensor]:
        """Return the part of B frames to cache, (B, 1, …): their tokens if the model encodes frames, else all of it."""
        with self._autocast():
            tokens = self._encode(frame)
        if tokens is None:
            return {**frame["rgb"], "state": frame["state"], "present": frame["present"]}
        # A CUDA graph overwrites its output in the next call.
        return {"tokens": tokens.clone(), "present": frame["present"]}

    def _tensor(self, values: Array) -> Tensor:
        return torch.from_numpy(values.copy())[None, None].to(self.device)


def plan_together(policies: Sequence[Policy], observations: Sequence[Observation]) -> list[Array]:
    """Call `plan` of several sessions of one policy, each with its observation, in one pass through the model.

    Actions differ from those of `plan` by rounding, because products of other sizes are summed in another order.
    Instructions whose tokens have different lengths take one pass per length.

    Raises:
        ValueError: an observation does not match the spec.
    """
    frames = []
    for policy, observation in zip(policies, observations, strict=True):
        policy._follow(observation.instruction)
        frames.append(policy.frame(observation))
    plans: dict[int, Array] = {}
    for length in {frame["text"].shape for frame in frames}:
        group = [index for index, frame in enumerate(frames) if frame["text"].shape == length]
        first = policies[group[0]]
        encoded = first._encoded(_joined([frames[index] for index in group]))
        for row, index in enumerate(group):
            policies[index]._frames.append({name: values[row : row + 1] for name, values in encoded.items()})
        actions, _ = first._predicted(_joined([policies[index]._inputs() for index in group]))
        plans.update(zip(group, actions, strict=True))
    return [plans[index] for index in range(len(policies))]


def _joined(batches: Sequence[Batch]) -> Batch:
    """Concatenate batches, which may hold mappings of tensors."""
    return {
        name: _joined([batch[name] for batch in batches])
        if isinstance(value, dict)
        else torch.cat([batch[name] for batch in batches])
        for name, value in batches[0].items()
    }


def costs(policy: Policy) -> dict[str, float]:
    """Return the number of parameters of a policy and its latency [ms], under the names of a report's file."""
    return {"parameters": sum(p.numel() for p in policy.model.parameters()), "latency_ms": latency(policy)}


def latency(policy: Policy) -> float:
    """Measure the time from an observation to its action with a full history [ms].

    It is the smallest of five medians over five plans, because other load only adds time.
    """
    observation = policy.spec.random_observation(np.random.default_rng(0))
    for _ in range(policy.model.history):
        policy.plan(observation)
    seconds = []
    for _ in range(25):
        started = time.perf_counter()
        policy.plan(observation)
        seconds.append(time.perf_counter() - started)
    return 1000 * float(np.median(np.reshape(seconds, (5, 5)), axis=1).min())
