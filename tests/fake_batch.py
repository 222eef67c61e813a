"""Windows of noise in the form that the loader gives them, and small models to try on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from defaults import defaults_of, part_of
from toy import SPEC

from vla.models.act import ACT
from vla.models.bc import BC
from vla.models.context import KeypointContext, TokenContext
from vla.models.decoder import Decoder
from vla.models.denoiser import DenoisingModel
from vla.models.diffusion import Diffusion
from vla.models.flow import Flow
from vla.models.model import Model
from vla.models.rt1 import RT1
from vla.models.text.ngrams import NGrams
from vla.models.tokenizers.tokenizer import Uniform
from vla.models.vision.image_tokenizer import FilmConv
from vla.policy import Policy
from vla.spec import ActionStatistics, Spec

TINY_IMAGE = partial(FilmConv, [8, 8], [5, 3], [2, 1], chroma=True, positions=False, log_pixels=False)
OF_CONTEXT = ("history", "learned_tokens", "keypoints", "proprioception")
TINY_TEXT = partial(NGrams, **defaults_of("model/text/ngrams", vocabulary=64, dropout=0.0))


class Motions(ActionStatistics):
    """Statistics of smooth motions, mostly small, with a gripper that closes on the way, as of a store of them."""

    def __init__(self, steps: int = 4000, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        moves = np.convolve(random.laplace(0, 0.012, 2 * steps + 18), np.hanning(11)[1:-1] / 5, "valid")
        moves = np.clip(moves[: 2 * steps].reshape(2, steps).T, -0.05, 0.05)
        closed = np.sin(np.arange(steps) / 9) > 0.3
        actions = np.concatenate([moves, 1.0 - closed[:, None]], 1).astype(np.float32)
        super().__init__(actions, np.array([steps]))

    def chunks(self, length: int) -> np.ndarray:
        """Every chunk there is."""
        return np.lib.stride_tricks.sliding_window_view(self.actions, length, 0).transpose(0, 2, 1)


MOTIONS = Motions()


def make_batch(frames: int, chunk: int = 1, size: int = 4, spec: Spec = SPEC) -> dict[str, Any]:
    """A batch of `size` windows with random images and actions, and sentences that differ."""
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    batch = {
        "rgb": {name: torch.randint(256, (size, frames, *spec.image_size, 3)).byte() for name in spec.cameras},
        "state": torch.randn(size, frames, len(spec.state)),
        "present": torch.ones(size, frames, dtype=torch.bool),
        "instruction": [f"lift the block number {number}" for number in range(size)],
        "action": low + (high - low) * torch.rand(size, frames, chunk, len(spec.action)),
        "valid": torch.ones(size, frames, chunk, dtype=torch.bool),
        "truth": torch.randn(size, frames, spec.truth_size),
    }
    none = torch.zeros(size, frames, chunk, dtype=torch.long)
    return {**batch, "executed": batch["action"], "perturbations": none}


def with_text(model: Model, batch: dict[str, Any]) -> dict[str, Any]:
    """The batch with its sentences as tokens, as the learner hands it over."""
    return {**batch, "text": model.text.tokenize(batch["instruction"])}


def with_motions(model: Model) -> dict[str, Any]:
    """A batch of noise for a model, with motions as labels."""
    batch, chunks = with_text(model, make_batch(model.history, model.chunk)), MOTIONS.chunks(model.chunk)
    rows = np.random.default_rng(0).integers(len(chunks), size=(4, model.history))
    return {**batch, "action": torch.from_numpy(chunks[rows])}


def context_of(option: str, **changes: Any) -> Callable[..., Any]:
    """The context of a model, with some changes."""
    options = part_of(option, "context", **changes)
    return partial(TokenContext if "history" in options else KeypointContext, **options)


def _small(kind: Callable[..., Any], option: str, small: dict[str, Any], options: dict[str, Any]) -> Any:
    """A model of an option, smaller and without random shifts; some of `options` are those of its context."""
    sizes = {"text_width": 16, "width": 32, "auxiliary": 1.0, "shift": (0, 0)}
    spec = options.get("spec", SPEC)
    tokenizer = Uniform(spec=spec, **defaults_of("tokenizer/uniform", bins=64))
    parts: dict[str, Any] = {"image": TINY_IMAGE, "text": TINY_TEXT, "spec": spec, "tokenizer": tokenizer}
    own = {name: options.pop(name) for name in OF_CONTEXT if name in options and kind is not BC}
    if kind is not BC and "context" not in options:
        parts["context"] = context_of(option, **{"keypoints": 8, **own})
    return kind(**{**parts, **defaults_of(option, **{**sizes, **small, **options})})


def make_bc(**options: Any) -> BC:
    """A small BC."""
    return _small(BC, "model/bc", {"width": 64, "keypoints": 8}, options)


def make_rt1(**options: Any) -> RT1:
    """A small RT-1 without dropout."""
    small = {"image_size": None, "layers": 2, "heads": 2, "key_width": 16, "dropout": 0.0}
    return _small(RT1, "model/rt1", small, {"history": 3, "learned_tokens": 2, **options})


def make_decoder(**options: Any) -> Decoder:
    """A small decoder."""
    return _small(Decoder, "model/decoder", {"heads": 2, "feedforward": 64}, {"learned_tokens": 2, **options})


def make_act(**options: Any) -> ACT:
    """A small ACT."""
    return _small(ACT, "model/act", {"chunk": 4, "heads": 2, "latent": 4}, options)


def make_denoising(kind: type[DenoisingModel], **options: Any) -> DenoisingModel:
    """A small model that starts from noise."""
    return _small(kind, f"model/{kind.__name__.lower()}", {"chunk": 4, "layers": 2, "heads": 2, "copies": 8}, options)


MODELS: dict[str, Callable[..., Any]] = {
    **{"bc": make_bc, "rt1": make_rt1, "decoder": make_decoder, "act": make_act},
    **{"diffusion": partial(make_denoising, Diffusion), "flow": partial(make_denoising, Flow)},
}


def as_policy(model: Model, spec: Spec = SPEC, **options: Any) -> Policy:
    """The agent that the configuration makes of a model, with some changes."""
    return Policy(**defaults_of("policy/default", **options), model=model, spec=spec)


def overfit(model: Model, batch: dict[str, Any], steps: int = 150) -> torch.Tensor:
    """Train on one batch; returns the mean error of the predicted actions, as a part of each one's range."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3, fused=True)
    for _ in range(steps):
        optimizer.zero_grad()
        model.loss(batch)["loss"].backward()
        optimizer.step()
    model.eval()
    with torch.inference_mode():
        actions = model.predict(batch).actions
    span = torch.tensor(model.spec.high) - torch.tensor(model.spec.low)
    return ((actions - batch["action"][:, -1]).abs() / span).mean()
