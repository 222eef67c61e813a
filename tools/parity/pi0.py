"""Compares π0 with transformers' own, of equal weights, noise and times, and writes what the tests compare with.

PYTHONPATH=.:tests python tools/parity/pi0.py
"""

from __future__ import annotations

from typing import Any

import torch
from references import write
from tiny_pi import CHUNK, SIZES, STATE_WIDTH, STEPS, inputs, make_network
from torch import Tensor
from transformers import PI0Config, PI0ForConditionalGeneration

IMAGE = SIZES["vocabulary"] - 1  # the token that stands for a patch
GRADIENTS = (  # of the network, by its names here
    "paligemma.vision_tower.encoder.layers.0.mlp.fc1.weight",
    "paligemma.language_model.layers.0.self_attn.v_proj.weight",
    "expert.layers.1.mlp.down_proj.weight",
)


def their_name(name: str) -> str:
    """Return what transformers calls a weight that is called `name` here."""
    for prefix, target in (("paligemma.", "model.vlm."), ("expert.", "model.dit."), ("action_out_", "action_out_")):
        if name.startswith(prefix):
            return target + name.removeprefix(prefix)
    return f"embed_action_time.{name}"


def their_network() -> PI0ForConditionalGeneration:
    """The network of transformers."""
    gemma = {"num_attention_heads": SIZES["heads"], "num_key_value_heads": 1, "head_dim": SIZES["head_width"]}
    gemma |= {"model_type": "gemma", "num_hidden_layers": SIZES["layers"], "vocab_size": SIZES["vocabulary"]}
    text = {**gemma, "hidden_size": SIZES["width"], "intermediate_size": SIZES["feedforward"]}
    expert = {**gemma, "hidden_size": SIZES["expert_width"], "intermediate_size": SIZES["expert_feedforward"]}
    vision = {
        **{"model_type": "siglip_vision_model", "vision_use_head": False},
        **{"hidden_size": SIZES["vision_width"], "num_hidden_layers": SIZES["vision_layers"]},
        **{"num_attention_heads": SIZES["vision_heads"], "intermediate_size": SIZES["vision_feedforward"]},
        **{"image_size": SIZES["resolution"], "patch_size": SIZES["patch"]},
    }
    trunk = {"model_type": "paligemma", "text_config": text, "vision_config": vision}
    trunk |= {"projection_dim": SIZES["width"], "image_token_index": IMAGE}
    widths = {"max_state_dim": STATE_WIDTH, "max_action_dim": SIZES["action_width"]}
    config = PI0Config(
        vlm_config=trunk,
        dit_config=expert,
        chunk_size=CHUNK,
        num_inference_steps=STEPS,
        loss_reduction="none",
        **widths,
    )
    return PI0ForConditionalGeneration(config).eval()


def as_theirs(given: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the arguments of their network: tokens stand for the patches of the cameras that are present."""
    patches = (SIZES["resolution"] // SIZES["patch"]) ** 2
    rows = [
        torch.cat([torch.full((patches * int(cameras.sum()),), IMAGE), tokens[sentence]])
        for cameras, tokens, sentence in zip(given["cameras"], given["tokens"], given["sentence"], strict=True)
    ]
    ids = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
    mask = torch.nn.utils.rnn.pad_sequence([torch.ones_like(row) for row in rows], batch_first=True)
    images = {"pixel_values": given["images"], "pixel_attention_mask": given["cameras"]}
    return {"state": given["state"], "input_ids": ids, "attention_mask": mask, **images}


def their_results(theirs: PI0ForConditionalGeneration, given: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return losses, (B, k, A), their gradients, and the actions at the beginning of every step and after the last."""
    targets = {"noise": given["noise"], "timestep": given["time"], "actions": given["actions"]}
    losses = theirs(**as_theirs(given), **targets).loss
    losses.mean().backward()
    parameters = dict(theirs.named_parameters())
    steps: list[Tensor] = []

    def record(module: Any, args: Any, values: dict[str, Any]) -> None:
        steps.append(values["noise"])

    handle = theirs.register_forward_pre_hook(record, with_kwargs=True)
    steps.append(theirs.sample_actions(**as_theirs(given), noise=given["noise"]))
    handle.remove()
    gradients = {f"gradient.{name}": parameters[their_name(name)].grad for name in GRADIENTS}
    return {"losses": losses.detach(), "steps": torch.stack(steps), **gradients}


def main() -> None:
    """Write what the network of transformers computes."""
    reference, network = their_network(), make_network("pi0")
    embedding = reference.model.dit.embed_tokens.weight  # the expert reads no words
    state = {their_name(name): weight for name, weight in network.state_dict().items()}
    reference.load_state_dict({**state, "model.dit.embed_tokens.weight": embedding})
    write("pi0", their_results(reference, inputs()))


if __name__ == "__main__":
    main()
