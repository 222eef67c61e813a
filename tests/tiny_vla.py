"""Vision-language-action models of a few thousand weights, which are the same in every package that can hold them."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

REFERENCE = Path(__file__).parent / "vla_references"

# Arguments of vla.models.vlm.smolvla.SmolVLA.
SMOLVLA: dict[str, Any] = {
    **{"vocabulary": 64, "width": 48, "layers": 4, "heads": 6, "key_heads": 2, "head_width": 8, "feedforward": 64},
    **{"vision_width": 24, "vision_layers": 2, "vision_heads": 3, "vision_feedforward": 32},
    **{"resolution": 32, "patch": 4, "shuffle": 4, "expert_width": 36, "expert_feedforward": 256, "joint_every": 2},
    **{"state_width": 32, "action_width": 32},
}


def fill(weights: Iterable[tuple[str, Tensor]]) -> None:
    """Set named weights to random numbers that their names determine; those of norms are close to 1."""
    with torch.no_grad():
        for name, weight in weights:
            random = np.random.default_rng(zlib.crc32(name.encode()))
            values = random.standard_normal(tuple(weight.shape)) * weight[0].numel() ** -0.5
            weight.copy_(torch.from_numpy(1 + values if "norm" in name and weight.dim() == 1 else values))


@cache
def reference(name: str) -> dict[str, Tensor]:
    """What another package computed, as `make parity` wrote it."""
    return load_file(REFERENCE / f"{name}.safetensors")


def deviation(ours: Tensor, theirs: Tensor) -> float:
    """The largest difference, relative to the largest value."""
    assert ours.shape == theirs.shape
    return float((ours.double() - theirs.double()).abs().max() / theirs.double().abs().max())
