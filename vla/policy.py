"""A trained model as an agent: observations in, actions out."""

# T frames of history, k action chunk, D action components, K bins

from __future__ import annotations

import os
import time
from collections import deque
from dataclasses import dataclass, replace
from getpass import getuser
from pathlib import Path
from pickle import UnpicklingError
from tempfile import gettempdir
from typing import Any, Literal
from zipfile import ZIP_STORED, BadZipFile, ZipFile
from zlib import crc32

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from vla.documents import require_resolved
from vla.models.model import Model
from vla.spec import LONGEST_INSTRUCTION, Array, Observation, Spec

Batch = dict[str, Any]

NODES = ("task", "tokenizer", "model")  # what a checkpoint's configuration says of a policy
# What else it may say, also as mappings.
OTHERS = ("chosen", "expert", "collect", "data", "learner", "trainer", "validate")
OF_TRUTH = ("truth_head", "truth_scale")  # parts of a model that are needed in training only
KEPT_IN = "TORCHINDUCTOR_CACHE_DIR"  # the variable from which PyTorch's compiler takes the folder
LONG = " ".join(["sentence"] * 24)  # what is compiled for a text of this length is so for all shorter ones


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds of a policy."""

    path: Path
    config: dict[str, Any]  # the configuration that trained it
    spec: Spec
    state: dict[str, Tensor]  # of the model
    finished: bool  # whether the training came to its end

    def restore(self, model: torch.nn.Module) -> None:
        """Load the weights.

        Raises:
            ValueError: they are those of another model.
        """
        try:
            model.load_state_dict(self.state)
        except (RuntimeError, TypeError, AttributeError) as error:  # the latter for values that are no tensors
            first = str(error).strip().splitlines()[-1].strip()[:200]
            raise ValueError(f"{self.path} does not fit the model of its own configuration: {first}") from error

    def start(self, model: Model) -> None:
        """Load the weights, to train them further; the head that predicts the truth starts anew where that differs.

        Raises:
            ValueError: they are those of another model.
        """
        state = self.state
        if self.spec.truth != model.spec.truth:
            state = {name: value for name, value in state.items() if name.partition(".")[0] not in OF_TRUTH}
            for part, module in model.named_children():
                if part in OF_TRUTH:
                    state |= {f"{part}.{name}": value for name, value in module.state_dict().items()}
        replace(self, state=state).restore(model)


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint as data: no code in it runs, and its configuration holds resolved plain values.

    Raises:
        ValueError: there is no file, it is damaged, or it is not a checkpoint of this project.
        OSError: it may not be read.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}: those of a run lie in outputs/runs/…/checkpoints")
    content = _load(path)
    config, spec, state = (content.get(name) for name in ("config", "spec", "state_dict"))
    if config is None or spec is None:
        raise ValueError(f"{path} is no checkpoint of this project: it carries no configuration and spec")
    require_resolved(config, f"the configuration in {path}")
    _require_nodes(config, path)
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise ValueError(f"{path} holds no weights: copy it again from where it is whole")
    prefix = "model."
    state = {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}
    return Checkpoint(path, config, Spec.from_dict(spec), state, content.get("finished") is True)


def _load(path: Path) -> dict[str, Any]:
    try:
        # Old pickles, which torch would read too, fail in any way they like.
        with path.open("rb") as file, ZipFile(file) as archive:
            entries = archive.infolist()
            # torch compresses nothing, so what unpacks to more than the file would fill the memory on purpose.
            packed = any(entry.compress_type != ZIP_STORED for entry in entries)
            if packed or sum(entry.file_size for entry in entries) > path.stat().st_size:
                raise BadZipFile("its parts are compressed or overlap")
            if archive.testzip() is not None:  # torch does not look at the checksums
                raise BadZipFile("checksums do not fit")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, UnpicklingError, EOFError, LookupError, TypeError, AttributeError, BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as a checkpoint, it is damaged or something else") from error
    return content if isinstance(content, dict) else {}


def _require_nodes(config: Any, path: Path) -> None:
    nodes = all(isinstance(config.get(name), dict) for name in NODES) if isinstance(config, dict) else False
    if not nodes or not all(isinstance(config.get(name, {}), dict) for name in OTHERS):
        raise ValueError(f"{path} is no checkpoint of this project: its configuration lacks {', '.join(NODES)}")


class Allowance(TorchFunctionMode):
    """Within, tensors are made up to a size that the weights in a checkpoint could fill.

    A configuration that asks for more is refused at the tensor that exceeds it, before anything is written there.
    """

    FACTORIES = (torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn)

    def __init__(self, checkpoint: Path) -> None:
        super().__init__()
        self._path, self._left = checkpoint, 2 * checkpoint.stat().st_size + 2**26

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func` and count what it made.

        Raises:
            ValueError: it is more than the file can hold.
        """
        try:
            made = func(*args, **(kwargs or {}))
            self._left -= made.nbytes if func in self.FACTORIES else 0
        except RuntimeError as error:
            if func not in self.FACTORIES:
                raise
            raise self._refusal() from error
        if self._left < 0:
            raise self._refusal()
        return made

    def _refusal(self) -> ValueError:
        return ValueError(f"{self._path} describes a model that is larger than the file, which does not hold it")


class Policy:
    """Acts with a model: keeps its history, encodes every frame once, executes as much of each chunk as the model says.

    Args:
        device: where to compute; "auto" takes a GPU if there is one.
        precision: 32, or "bf16" for matrix products in bfloat16.
        compile: compile the model, which takes up to a minute at the first action and needs g++ on a CPU: there its
            constants are folded into its weights, on a GPU it becomes CUDA graphs.
        model: the network, with its tokenizer.
        spec: what a step looks like.

    Raises:
        ValueError: a GPU is asked for where there is none.
    """

    def __init__(
        self,
        device: Literal["auto", "cpu", "cuda"] = "auto",
        precision: Literal[32, "bf16"] = 32,
        compile: bool = False,
        *,
        model: Model,
        spec: Spec,
    ) -> None:
        if device == "cuda" and not torch.cuda.is_available():
            raise ValueError("policy.device=cuda, but PyTorch finds no GPU here: policy.device=auto does with the CPU")
        usable = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(usable if device == "auto" else device)
        self.model, self.spec = model.eval().to(self.device), spec
        self.execute = model.execute  # so many actions of a chunk, before it looks again
        self.info: dict[str, Any] = {}
        self._half = precision == "bf16"
        self._encode, self._decide = self.model.encode, self.model.predict
        self._beside = [LONG] if compile else []  # sentences to whose length others are filled up
        if compile:
            keep_by_processor()
            how: dict[str, Any] = {"options": {"freezing": True}}
            if self.device.type == "cuda":
                how = {"mode": "reduce-overhead"}
            self._encode = torch.compile(self.model.encode, **how)
            self._decide = torch.compile(self.model.predict, **how)
        self._low, self._high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._frames: deque[dict[str, Tensor]] = deque(maxlen=model.history)
        self._chunk: deque[tuple[Array, dict[str, Any]]] = deque()
        self.reset("", 0)

    def reset(self, instruction: str, seed: int) -> None:
        """Forget the past; what the model draws from now on follows from `seed`.

        Raises:
            ValueError: the instruction has more than `LONGEST_INSTRUCTION` characters.
        """
        if len(instruction) > LONGEST_INSTRUCTION:
            raise ValueError(f"an instruction has at most {LONGEST_INSTRUCTION} characters, not {len(instruction)}")
        self._random = torch.Generator().manual_seed(seed)
        self._frames.clear()
        self._chunk.clear()
        self._instruction = instruction
        self._text = self.model.text.tokenize([instruction, *self._beside])[:1].to(self.device)

    def act(self, observation: Observation) -> Array:
        """The (D,) float32 action to execute, within the spec's bounds; `info` may have its token probabilities (D, K).

        Raises:
            ValueError: the observation is not what the policy was trained on.
        """
        self._see(observation)
        if not self._chunk:
            actions, probabilities = self._predict()
            told = [{}] * len(actions) if probabilities is None else [{"probabilities": each} for each in probabilities]
            self._chunk.extend(list(zip(actions, told, strict=True))[: self.execute])
        action, self.info = self._chunk.popleft()
        return action

    def plan(self, observation: Observation) -> Array:
        """The (k, D) float32 actions of a whole chunk, within the spec's bounds, of which the first `execute` are to be
        executed, for those who time them themselves.

        Raises:
            ValueError: the observation is not what the policy was trained on.
        """
        self._see(observation)
        return self._predict()[0]

    def _see(self, observation: Observation) -> None:
        if observation.instruction != self._instruction:
            self.reset(observation.instruction, 0)
        self._frames.append(self._kept(self.frame(observation)))

    @torch.inference_mode()
    def _predict(self) -> tuple[Array, Array | None]:
        """Actions (k, D), clipped, and token probabilities (k, D, K), where the model has them."""
        drawn = self.model.draw(self._random)
        noise = {} if drawn is None else {"noise": drawn.to(self.device)}
        with self._computing():
            actions, probabilities = self._decide({**self.window(), **noise})
        told = None if probabilities is None else probabilities[0].float().cpu().numpy()
        return np.clip(actions[0].float().cpu().numpy(), self._low, self._high), told

    def _computing(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._half)

    def window(self) -> Batch:
        """What the model is given now, a batch of one: the frames seen so far, and absent ones up to its history."""
        absent = {name: torch.zeros_like(values) for name, values in self._frames[0].items()}
        frames = [*self._frames, *[absent] * (self.model.history - len(self._frames))]
        joined = {name: torch.cat([frame[name] for frame in frames], 1) for name in absent}
        rgb = {name: joined.pop(name) for name in self.spec.cameras if name in joined}
        return {**joined, "rgb": rgb, "text": self._text}

    def frame(self, observation: Observation) -> Batch:
        """One observation as a batch of one frame.

        Raises:
            ValueError: the observation is not what the policy was trained on.
        """
        shape = (*self.spec.image_size, 3)
        seen = {camera: image.shape for camera, image in observation.rgb.items()}
        if any(seen.get(camera) != shape for camera in self.spec.cameras):
            raise ValueError(f"the policy looks through {self.spec.cameras} in {shape}, the observation has {seen}")
        proprio = np.concatenate([observation.joints, observation.velocities, [observation.gripper]])
        return {
            "rgb": {camera: self._tensor(observation.rgb[camera]) for camera in self.spec.cameras},
            "proprio": self._tensor(proprio.astype(np.float32)),
            "present": torch.ones(1, 1, dtype=torch.bool, device=self.device),
            "text": self._text,
        }

    @torch.inference_mode()
    def _kept(self, frame: Batch) -> dict[str, Tensor]:
        """What is kept of a frame, (1, 1, …): its tokens where the model can do with them, else all of it."""
        with self._computing():
            tokens = self._encode(frame)
        if tokens is None:
            return {**frame["rgb"], "proprio": frame["proprio"], "present": frame["present"]}
        # A CUDA graph writes its next result where it wrote this one.
        return {"tokens": tokens.clone(), "present": frame["present"]}

    def _tensor(self, values: Array) -> Tensor:
        return torch.from_numpy(values.copy())[None, None].to(self.device)


def keep_by_processor() -> None:
    """Set the folder in which PyTorch keeps compiled graphs, unless it is set, to one for this kind of processor.

    Frozen weights are laid out for a processor. Graphs that were compiled on another one, of the same home folder or
    with other instructions switched off, were seen to give other actions without an error.
    """
    if KEPT_IN not in os.environ:
        features = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
        kind = (torch.backends.cpu.get_cpu_capability(), os.environ.get("ONEDNN_MAX_CPU_ISA"), features)
        os.environ[KEPT_IN] = f"{gettempdir()}/torchinductor_{getuser()}_{crc32(repr(kind).encode()):08x}"


def noise(spec: Spec, random: np.random.Generator) -> Observation:
    """An observation in which everything is random but the instruction."""
    rgb = {camera: random.integers(256, size=(*spec.image_size, 3), dtype=np.uint8) for camera in spec.cameras}
    joints, velocities = random.uniform(-1, 1, (2, len(spec.joints))).astype(np.float32)
    return Observation(rgb, {}, joints, velocities, random.uniform(0, 0.08), "lift the red block")


def latency(policy: Policy, rounds: int = 5, plans: int = 20) -> float:
    """Time from an observation to its action, with a full history [ms]: of several medians the least, as whatever else
    the machine is busy with only adds."""
    observation = noise(policy.spec, np.random.default_rng(0))
    for _ in range(policy.model.history):
        policy.plan(observation)
    medians = []
    for _ in range(rounds):
        seconds = []
        for _ in range(plans):
            started = time.perf_counter()
            policy.plan(observation)
            seconds.append(time.perf_counter() - started)
        medians.append(float(np.median(seconds)))
    return 1000 * min(medians)
