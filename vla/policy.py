"""A trained model as an agent: observations in, actions out."""

# k action chunk, D action components, K bins

from __future__ import annotations

import logging
import timeit
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from math import isfinite
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from vla.io.errors import UserError
from vla.io.types import Count
from vla.models.chunking import Chunking, TrainedPrefix, require_chunking
from vla.models.compilation import prepare_compilation
from vla.models.layers import Batch
from vla.models.model import Model
from vla.schedule import Schedule
from vla.spec import LONGEST_INSTRUCTION, Array, Observation, RunningPlan, Spec

log = logging.getLogger(__name__)

PolicyInput = Observation | Mapping[str, Any] | Sequence[Observation | Mapping[str, Any]]  # of one lane, or of several
NO_PLAN = RunningPlan(np.empty((0, 1), np.float32), 0)  # no plan is executed
LONG_SENTENCE = " ".join(["sentence"] * 24)  # shorter instructions are padded to it for a constant shape


@dataclass
class _Lane:
    """The state of a policy in one episode."""

    seed: int  # of the episode
    instruction: str
    text: Tensor  # (1, L) its tokens
    random: torch.Generator  # of the noise of the model
    frames: deque[dict[str, Tensor]]  # encoded frames of the history, (1, 1, …) each, the newest last
    schedule: Schedule[tuple[Array, dict[str, Any]]] = field(default_factory=Schedule)  # actions with their `info`
    step: int = 0  # number of executed actions
    info: dict[str, Any] = field(default_factory=dict)  # about the last action


def torch_device(device: Literal["auto", "cpu", "cuda"]) -> torch.device:
    """Return the device that `policy.device` names; a UserError if that is a GPU, and there is none."""
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("policy.device=cuda, but PyTorch finds no GPU here: policy.device=auto uses the CPU")
    best_device = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(best_device if device == "auto" else device)


class Policy:
    """Agents that share a model: each caches encoded frames of its history, and executes the first actions of a chunk.

    Every lane, identified by a number, is an agent in its own episode. Its actions are bit-identical whatever the other
    lanes do and however many there are: the rounding of a matrix product depends on its shape and on the row, so the
    model always computes `lanes` rows, padding unused ones, and an episode uses row `seed % lanes`. Lanes with the same
    row, or with instructions of different lengths, are computed in separate passes.

    Args:
        device: "auto" is a GPU if there is one.
        precision: "fp32", or "bf16" for matrix products in bfloat16.
        compile: compile the model, which takes up to a minute at the first action and needs g++ on a CPU. On a GPU
            CUDA graphs are used. Weights stay inputs of the graphs, so that models of one class share them.
        lanes: rows of every pass through the model.
        chunking: how a plan continues the running one (`act`: the lane's last, `plan`: `Observation.running`), or None.
        model: the network, with its tokenizer.
        spec: observation and action spaces.

    Raises:
        UserError: device="cuda" without a GPU, or a `chunking` that the model does not support.
    """

    def __init__(
        self,
        device: Literal["auto", "cpu", "cuda"],
        precision: Literal["fp32", "bf16"],
        compile: bool,
        lanes: Count,
        chunking: Chunking | None = None,
        *,
        model: Model,
        spec: Spec,
    ) -> None:
        self.device = torch_device(device)
        self.model, self.spec, self.lanes = model.eval().to(self.device), spec, lanes
        self.chunking = chunking
        if chunking is not None:
            require_chunking(type(chunking), type(model), model.prefix)
            model.chunking = chunking
        self._longest_delay = model.prefix if isinstance(chunking, TrainedPrefix) else model.chunk
        self._warned = False  # that plans arrive later
        self.execute = model.execute  # number of actions of a chunk to execute
        self.history = model.history  # number of input frames; if several, it must be given every observation
        self._bf16 = precision == "bf16"
        self._encode, self._predict_chunk = self.model.encode, self.model.predict
        self._padding_sentences = [LONG_SENTENCE] if compile else []
        if compile:
            prepare_compilation()
            mode = "reduce-overhead" if self.device.type == "cuda" else None
            self._encode = torch.compile(self.model.encode, mode=mode)
            self._predict_chunk = torch.compile(self.model.predict, mode=mode)
        self._low, self._high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._lanes = dict[int, _Lane]()
        self.reset("", 0)

    def reset(self, instruction: str, seed: int, lane: int = 0) -> None:
        """Start an episode in a lane: clear its history, and seed its noise.

        The first observation of a lane that was never reset starts an episode with the lane's number as its seed. An
        observation with a new instruction starts one with the seed of the episode before it.

        Raises:
            UserError: the instruction has more than `LONGEST_INSTRUCTION` characters.
        """
        if len(instruction) > LONGEST_INSTRUCTION:
            raise UserError(f"an instruction has at most {LONGEST_INSTRUCTION} characters, not {len(instruction)}")
        text = self.model.text.tokenize([instruction, *self._padding_sentences])[:1].to(self.device)
        random, frames = torch.Generator().manual_seed(seed), deque[dict[str, Tensor]](maxlen=self.history)
        self._lanes[lane] = _Lane(seed, instruction, text, random, frames)

    @property
    def info(self) -> dict[str, Any]:
        """What is known about the last action of lane 0."""
        return self.about(0)

    def about(self, lane: int) -> dict[str, Any]:
        """Return what is known about the last action of a lane: token probabilities (D, K), if the model has them."""
        return self._lanes[lane].info

    def looking(self, lane: int) -> bool:
        """Return whether `act` uses the next observation of a lane, for a new plan or for the history."""
        return self._wants_plan(lane) or self.history > 1

    def _wants_plan(self, lane: int) -> bool:
        return self._lanes[lane].schedule.wants_plan(self._lanes[lane].step, self.execute)

    def act(self, observations: PolicyInput, lanes: Sequence[int] | None = None) -> Array:
        """Return the next actions of n lanes, (n, D) float32, clipped to the spec, given an observation of each.

        Without `lanes`, return the action (D,) for one observation of lane 0, also one of `vla.api.load_environment`.

        Raises:
            UserError: an observation does not match the spec, in which case no lane acts.
        """
        if lanes is None:
            return self.act([self._observation(observations)], [0])[0]
        lane_observations = self._assign_lanes(observations, lanes)
        self._observe({lane: observation for lane, observation in lane_observations.items() if self.looking(lane)})
        running = dict[int, RunningPlan]()  # the end of the old plan of every lane that wants a new one
        for lane in filter(self._wants_plan, lanes):
            rest = [action for action, _ in self._lanes[lane].schedule.remaining_actions(self._lanes[lane].step)]
            running[lane] = RunningPlan(np.reshape(rest, (-1, len(self._low))), 0)
        for lane, chunk in self._predict(running).items():
            self._lanes[lane].schedule.add(chunk, self._lanes[lane].step)
        actions = []
        for state in (self._lanes[lane] for lane in lanes):
            action, state.info = state.schedule.actions_at(state.step)[-1]
            state.step += 1
            actions.append(action)
        return np.stack(actions)

    def plan(self, observations: PolicyInput, lanes: Sequence[int] | None = None) -> Array:
        """Return chunks of actions, (n, k, D) float32, clipped to the spec; the caller executes the first of each.

        Without `lanes`, return the chunk (k, D) for the one observation of lane 0. Raises as `act`.
        """
        if lanes is None:
            return self.plan([self._observation(observations)], [0])[0]
        lane_observations = self._assign_lanes(observations, lanes)
        self._observe(lane_observations)
        plans = self._predict({lane: observation.running or NO_PLAN for lane, observation in lane_observations.items()})
        return np.stack([[action for action, _ in plans[lane]] for lane in lanes])

    def _observation(self, value: Any) -> Observation:
        return value if isinstance(value, Observation) else Observation.from_mapping(value, self.spec)

    def _assign_lanes(self, observations: Any, lanes: Sequence[int]) -> dict[int, Observation]:
        """Return lane → its observation; a lane with another instruction begins an episode."""
        lane_observations = dict(zip(lanes, map(self._observation, observations), strict=True))
        for lane, observation in lane_observations.items():
            state = self._lanes.get(lane)
            if state is None or observation.instruction != state.instruction:
                self.reset(observation.instruction, lane if state is None else state.seed, lane)
        return lane_observations

    def _observe(self, lanes: Mapping[int, Observation]) -> None:
        """Encode the observations of lanes and add them to the histories, or none if one does not match the spec."""
        for rows, frames in self._passes({lane: self.frame(observation, lane) for lane, observation in lanes.items()}):
            with self._inference_mode():
                tokens = self._encode(frames)
            features = {"present": frames["present"]}
            if tokens is None:
                features |= {**frames["rgb"], "state": frames["state"]}
            else:
                features["tokens"] = tokens.clone()  # a CUDA graph overwrites its output in the next call
            for row, lane in rows.items():
                self._lanes[lane].frames.append({name: values[row : row + 1] for name, values in features.items()})

    def _predict(self, lanes: Mapping[int, RunningPlan]) -> dict[int, list[tuple[Array, dict[str, Any]]]]:
        """Return lane → its chunk of clipped actions, (D,) each, with the `info` of each.

        With `chunking`, a chunk begins with the actions of the running plan that are executed before it arrives.
        """
        chunks = {}
        for rows, windows in self._passes({lane: self._inputs(lane, plan) for lane, plan in lanes.items()}):
            with self._inference_mode():
                prediction, probabilities = self._predict_chunk(windows)
            actions = np.clip(prediction.float().cpu().numpy(), self._low, self._high)
            for row, lane in rows.items() if self.chunking else ():
                prefix = lanes[lane].actions[: lanes[lane].delay][: len(actions[row])]
                actions[row, : len(prefix)] = prefix
            infos: list[list[dict[str, Any]]] = [[{} for _ in chunk] for chunk in actions]
            if probabilities is not None:
                infos = [[{"probabilities": item} for item in chunk] for chunk in probabilities.float().cpu().numpy()]
            chunks |= {lane: list(zip(actions[row], infos[row], strict=True)) for row, lane in rows.items()}
        return chunks

    def _passes(self, inputs: Mapping[int, Batch]) -> Iterator[tuple[dict[int, int], Batch]]:
        """Divide the inputs of lanes, batches of one, into passes with instructions of one length.

        Yields row → lane, and the batch of all rows; a row without a lane repeats the input of a lane.
        """
        passes: dict[int, list[dict[int, int]]] = {}  # length of the instruction → passes, each row → lane
        for lane in inputs:
            state = self._lanes[lane]
            row, candidates = state.seed % self.lanes, passes.setdefault(state.text.shape[1], [])
            rows = next((rows for rows in candidates if row not in rows), None)
            if rows is None:
                candidates.append(rows := {})
            rows[row] = lane
        for rows in chain.from_iterable(passes.values()):
            padding = next(iter(rows.values()))
            batches = [inputs[rows.get(row, padding)] for row in range(self.lanes)]
            yield rows, batches[0] if self.lanes == 1 else _concatenate(batches)

    @contextmanager
    def _inference_mode(self) -> Iterator[None]:
        with torch.inference_mode(), torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16):
            yield

    def _inputs(self, lane: int, running: RunningPlan) -> Batch:
        """Return the input of one prediction, with the next noise and the running plan if the model needs them."""
        inputs, noise = self.window(lane), self.model.sample_noise(self._lanes[lane].random)
        if noise is not None:
            inputs["noise"] = noise.to(self.device)
        if self.chunking is not None:
            rest = running.actions[: self.model.chunk]
            padded = np.zeros((self.model.chunk, len(self._low)), np.float32)
            padded[: len(rest)] = rest
            counts = {"remaining": len(rest), "delay": self._known_delay(min(running.delay, len(rest)))}
            inputs |= {name: torch.tensor([count], device=self.device) for name, count in counts.items()}
            inputs["running"] = torch.from_numpy(padded)[None].to(self.device)
        return inputs

    def _known_delay(self, delay: int) -> int:
        """Return the delay of a plan, or the longest one that the model was trained for, with a warning."""
        if delay > self._longest_delay and not self._warned:
            self._warned, text = True, "a plan arrives %d actions late, more than model.prefix=%d of its training: %s"
            log.warning(
                text, delay, self._longest_delay, "it may not continue the running one; train with a larger one"
            )
        return min(delay, self._longest_delay)

    def window(self, lane: int = 0) -> Batch:
        """Return the model input of a lane, a batch of one: the frames so far, padded to the history of the model."""
        state = self._lanes[lane]
        padding = {name: torch.zeros_like(values) for name, values in state.frames[0].items()}
        frames = [*state.frames, *[padding] * (self.history - len(state.frames))]
        inputs = {name: torch.cat([frame[name] for frame in frames], 1) for name in padding}
        rgb = {name: inputs.pop(name) for name in self.spec.cameras if name in inputs}
        return {**inputs, "rgb": rgb, "text": state.text}

    def frame(self, observation: Observation, lane: int = 0) -> Batch:
        """Convert an observation of a lane, with images of any size, to a batch of one frame that the model sees.

        Raises:
            UserError: the observation does not match the spec.
        """
        spec = self.spec
        if observation.state.shape != (len(spec.state),):
            raise UserError(f"the state must hold {', '.join(spec.state)}, but has the shape {observation.state.shape}")
        if names := [name for name, value in zip(spec.state, observation.state, strict=True) if not isfinite(value)]:
            raise UserError(f"the observation's state is not finite in {', '.join(names)}")
        rgb = spec.images(observation)
        if missing := [camera for camera in spec.cameras if camera not in rgb]:
            raise UserError(f"the observation lacks {', '.join(missing)}: the policy needs {', '.join(spec.cameras)}")
        for camera in spec.cameras:
            image = rgb[camera]
            if image.ndim != 3 or image.shape[2] != 3 or not image.size or image.dtype != np.uint8:
                kind = f"{image.dtype} of {image.shape}"
                raise UserError(f"the image of {camera} must be (H, W, 3) uint8, 0 to 255, and is {kind}")
            spec.require_cut(camera, image.shape, f"the image of {camera}")
        frame = {
            "rgb": {camera: self._tensor(rgb[camera]) for camera in spec.cameras},
            "state": self._tensor(np.asarray(observation.state, np.float32)),
            "present": torch.ones(1, 1, dtype=torch.bool, device=self.device),
            "text": self._lanes[lane].text,
        }
        return self.model.transforms(frame)

    def _tensor(self, values: Array) -> Tensor:
        return torch.from_numpy(values.copy())[None, None].to(self.device)


def _concatenate(batches: Sequence[Batch]) -> Batch:
    """Concatenate batches, which may hold mappings of tensors."""
    return {
        name: _concatenate([batch[name] for batch in batches])
        if isinstance(value, dict)
        else torch.cat([batch[name] for batch in batches])
        for name, value in batches[0].items()
    }


def costs(policy: Policy) -> dict[str, float]:
    """Return the number of parameters of a policy and its latency [ms], under their names in the file of a report.

    The latency is the time from an observation to its action with a full history, the smallest of five medians of five
    plans each, because other load on the machine only adds time.
    """
    observation = policy.spec.random_observation(np.random.default_rng(0))
    for _ in range(policy.model.history):
        policy.plan(observation)
    seconds = timeit.repeat(lambda: policy.plan(observation), number=1, repeat=25)
    latency = 1000 * float(np.median(np.reshape(seconds, (5, 5)), axis=1).min())
    return {"parameters": sum(p.numel() for p in policy.model.parameters()), "latency_ms": latency}
