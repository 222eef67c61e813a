"""Compares SmolVLA with LeRobot's own, of equal weights, noise and times, and writes what the tests compare with.

PYTHONPATH=FOLDER_OF_LEROBOT:. python tools/parity/smolvla.py
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

sys.path.append(str(Path(__file__).parents[2] / "tests"))

from lerobot_modules import prepare
from tiny_vla import REFERENCE, SMOLVLA, deviation, fill

prepare()

from lerobot.policies.smolvla import smolvlm_with_expert
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import VLAFlowMatching
from transformers import SmolVLMConfig

from vla.models.vlm.smolvla import SmolVLA

GRADIENTS = (  # of the network, by the names that LeRobot gives them
    "vlm_with_expert.vlm.model.vision_model.embeddings.patch_embedding.weight",
    "vlm_with_expert.vlm.model.text_model.layers.0.self_attn.v_proj.weight",
    "vlm_with_expert.lm_expert.layers.1.self_attn.k_proj.weight",
)
TOLERANCE = 1e-5


def their_config(sizes: dict[str, Any]) -> SmolVLMConfig:
    """The configuration of the trunk, as the hub has it."""
    text = {
        **{"model_type": "llama", "vocab_size": sizes["vocabulary"], "hidden_size": sizes["width"]},
        **{"num_hidden_layers": sizes["layers"], "num_attention_heads": sizes["heads"], "rms_norm_eps": 1e-5},
        **{"num_key_value_heads": sizes["key_heads"], "head_dim": sizes["head_width"], "pad_token_id": 2},
        **{"intermediate_size": sizes["feedforward"]},
    }
    vision = {
        **{"hidden_size": sizes["vision_width"], "num_hidden_layers": sizes["vision_layers"]},
        **{"num_attention_heads": sizes["vision_heads"], "intermediate_size": sizes["vision_feedforward"]},
        **{"image_size": sizes["resolution"], "patch_size": sizes["patch"]},
    }
    return SmolVLMConfig(text_config=text, vision_config=vision, scale_factor=sizes["shuffle"])


def their_network(sizes: dict[str, Any], chunk: int, **options: Any) -> VLAFlowMatching:
    """LeRobot's network with random weights, of which nothing is frozen."""
    smolvlm_with_expert.AutoConfig = SimpleNamespace(from_pretrained=lambda *_: their_config(sizes))
    tokens = SimpleNamespace(fake_image_token_id=3, global_image_token_id=4)
    smolvlm_with_expert.AutoProcessor = SimpleNamespace(from_pretrained=lambda *_: SimpleNamespace(tokenizer=tokens))
    frozen = {"freeze_vision_encoder": False, "train_expert_only": False}
    config = SmolVLAConfig(
        chunk_size=chunk, n_action_steps=chunk, num_vlm_layers=sizes["layers"], device="cpu", **frozen, **options
    )
    return VLAFlowMatching(config).eval()


def inputs(sizes: dict[str, Any], batch: int, cameras: int, length: int, chunk: int) -> dict[str, Tensor]:
    """Random inputs, of which the second row has a camera less and a shorter sentence."""
    random = torch.Generator().manual_seed(0)
    present, sentence = torch.ones(batch, cameras, dtype=torch.bool), torch.ones(batch, length, dtype=torch.bool)
    present[1:, -1], sentence[1:, length // 2 :] = False, False
    size = sizes["resolution"]
    actions = torch.randn(batch, chunk, sizes["action_width"], generator=random)
    return {
        "images": torch.rand(batch, cameras, 3, size, size, generator=random) * 2 - 1,
        "cameras": present,
        "tokens": torch.randint(sizes["vocabulary"], (batch, length), generator=random),
        "sentence": sentence,
        "state": torch.randn(batch, sizes["state_width"], generator=random),
        "actions": actions,
        "noise": torch.randn(actions.shape, generator=random),
        "time": torch.rand(batch, generator=random),
    }


def as_theirs(given: dict[str, Tensor]) -> tuple[Any, ...]:
    images, cameras = ([*given[name].unbind(1)] for name in ("images", "cameras"))
    return images, cameras, given["tokens"], given["sentence"], given["state"]


def their_results(theirs: VLAFlowMatching, given: dict[str, Tensor]) -> dict[str, Tensor]:
    losses = theirs(*as_theirs(given), given["actions"], given["noise"], given["time"])
    losses.mean().backward()
    named = dict(theirs.named_parameters())
    results = {f"gradient.{name}": named[name].grad for name in GRADIENTS}
    steps, denoise = [], theirs.denoise_step

    def recorded(**values: Any) -> Tensor:
        steps.append(values["x_t"])
        return denoise(**values)

    theirs.denoise_step = recorded
    with torch.no_grad():
        steps.append(theirs.sample_actions(*as_theirs(given), noise=given["noise"]))
    return {"losses": losses.detach(), "steps": torch.stack(steps), **results}
