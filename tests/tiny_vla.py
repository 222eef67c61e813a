"""Vision-language-action models of a few thousand weights, which are the same in every package that can hold them."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from defaults import defaults_of
from fake_batch import TINY_IMAGE
from safetensors.torch import load_file
from torch import Tensor

from vla.models.tokenizers.tokenizer import Uniform
from vla.models.vlm.network import FlowNetwork, rename_weight
from vla.models.vlm.policy import VisionLanguageAction
from vla.models.vlm.prompt import WORDS, Prompt
from vla.models.vlm.smolvla import SmolVLA
from vla.spec import Observation, Spec

REFERENCE = Path(__file__).parent / "vla_references"
BATCH, CAMERAS, LENGTH, CHUNK, EXECUTE = 2, 2, 12, 6, 4
SENTENCES = ("put the red block away", "wait\n", "a sentence of more than twelve tokens, which is cut")

# Arguments of vla.models.vlm.smolvla.SmolVLA.
SMOLVLA: dict[str, Any] = {
    **{"vocabulary": 320, "width": 48, "layers": 4, "heads": 6, "key_heads": 2, "head_width": 8, "feedforward": 64},
    **{"vision_width": 24, "vision_layers": 2, "vision_heads": 3, "vision_feedforward": 32},
    **{"resolution": 32, "patch": 4, "shuffle": 4, "image": None, "keypoints": 0, "joint_every": 2},
    **{"expert_width": 36, "expert_feedforward": 256},
    **{"state_width": 32, "action_width": 32},
}
KEYPOINTS: dict[str, Any] = {"image": TINY_IMAGE, "keypoints": 3}  # change to see instead of patches


def fill(weights: Iterable[tuple[str, Tensor]]) -> None:
    """Set named weights to random numbers that their names determine; those of norms are close to 1."""
    with torch.no_grad():
        for name, weight in weights:
            random = np.random.default_rng(zlib.crc32(name.encode()))
            values = random.standard_normal(tuple(weight.shape)) * weight[0].numel() ** -0.5
            weight.copy_(torch.from_numpy(1 + values if "norm" in name and weight.dim() == 1 else values))


def inputs(sizes: dict[str, Any]) -> dict[str, Tensor]:
    """Inputs of a network, of which the second row has a camera less and a shorter sentence."""
    random = np.random.default_rng(0)
    present, sentence = torch.ones(BATCH, CAMERAS, dtype=torch.bool), torch.ones(BATCH, LENGTH, dtype=torch.bool)
    present[1:, -1], sentence[1:, LENGTH // 2 :] = False, False
    size, chunk = sizes["resolution"], (BATCH, CHUNK, sizes["action_width"])
    values = {
        "images": random.uniform(-1, 1, (BATCH, CAMERAS, 3, size, size)),
        "state": random.standard_normal((BATCH, sizes["state_width"])),
        "actions": random.standard_normal(chunk),
        "noise": random.standard_normal(chunk),
        "time": random.uniform(0, 1, BATCH),
    }
    tokens = torch.from_numpy(random.integers(sizes["vocabulary"], size=(BATCH, LENGTH)))
    numbers = {name: torch.from_numpy(value).float() for name, value in values.items()}
    return {"cameras": present, "sentence": sentence, "tokens": tokens, **numbers}


SPEC = Spec(
    cameras=("front", "wrist"),
    image_size=(24, 40),
    state=("x", "y", "z", "gripper"),
    state_units=("m", "m", "m", "1"),
    action=("dx", "dy", "gripper"),
    units=("m", "m", "1"),
    low=(-9.0, -9.0, -9.0),
    high=(9.0, 9.0, 9.0),
    control_hz=10.0,
    truth=(("block", 3),),
)


def observation(number: int) -> Observation:
    """What a robot sees at a step."""
    random = np.random.default_rng(number)
    rgb = {camera: random.integers(256, size=(*SPEC.image_size, 3), dtype=np.uint8) for camera in SPEC.cameras}
    return Observation(rgb, random.uniform(-1, 1, len(SPEC.state)).astype(np.float32), SENTENCES[0])


def steps(components: int) -> np.ndarray:
    """States or actions of a dataset, (N, components)."""
    random = np.random.default_rng(components)
    return (random.standard_normal((500, components)) * (1 + np.arange(components)) + 0.3).astype(np.float32)


def write_tokenizer(folder: Path) -> None:
    """Write a tokenizer of bytes and a few of their pairs, as transformers reads it."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    merges = [("t", "h"), ("th", "e"), ("e", "d"), ("b", "l"), ("o", "c"), ("oc", "k")]
    known = ["<pad>", *sorted(pre_tokenizers.ByteLevel.alphabet()), *(first + second for first, second in merges)]
    tokenizer = Tokenizer(models.BPE({token: number for number, token in enumerate(known)}, merges))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>").save_pretrained(folder)


def make_smolvla(tokenizer: Path | None = None, **options: Any) -> VisionLanguageAction:
    """A tiny SmolVLA with the weights of `fill` and the statistics of `steps`."""
    parts: dict[str, Any] = {
        "network": partial(SmolVLA, **(SMOLVLA if tokenizer else {**SMOLVLA, "vocabulary": WORDS})),
        "text": partial(Prompt, str(tokenizer) if tokenizer else None, LENGTH, False),
        "tokenizer": Uniform(spec=SPEC, **defaults_of("tokenizer/uniform", bins=64)),
        "spec": SPEC,
    }
    chosen = {"chunk": CHUNK, "execute": EXECUTE, **options}
    model = VisionLanguageAction(**defaults_of("model/smolvla", **{**parts, **chosen}))
    if model.statistics == "demonstrations":
        model.fit(steps(len(SPEC.state)), steps(len(SPEC.action)))
    if not options.get("trunk"):
        fill(published(model.network))
    return model.eval()


def published(network: Any) -> Iterable[tuple[str, Tensor]]:
    """Name in LeRobot's class and weight."""
    beginnings = [(ours, theirs.removeprefix("model.")) for theirs, ours in network.published_names]
    return ((rename_weight(name, beginnings), weight) for name, weight in network.named_parameters())


# Weights whose gradients are compared, by the names in LeRobot's class.
GRADIENTS = (
    "vlm_with_expert.vlm.model.vision_model.embeddings.patch_embedding.weight",
    "vlm_with_expert.vlm.model.text_model.layers.0.self_attn.v_proj.weight",
    "vlm_with_expert.lm_expert.layers.1.self_attn.k_proj.weight",
)


def network_results(
    network: FlowNetwork, given: dict[str, Tensor], weights: dict[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Losses, gradients of some weights, and the noisy actions before every step of sampling and after the last."""
    observed = [given[name] for name in ("images", "cameras", "tokens", "sentence", "state")]
    noise, time = given["noise"], given["time"]
    noisy = time[:, None, None] * noise + (1 - time[:, None, None]) * given["actions"]
    losses = (network.velocity(network.prefix(*observed), noisy, time) - noise + given["actions"]).square()
    named = dict(published(network))
    weights = weights or {name: named[name] for name in GRADIENTS}
    found = torch.autograd.grad(losses.mean(), [*weights.values()])
    with torch.no_grad():
        prefix, taken = network.prefix(*observed), [noise]
        for step in range(10):
            velocity = network.velocity(prefix, taken[-1], torch.full((len(noise),), 1 - step / 10))
            taken.append(taken[-1] - velocity / 10)
    return {
        "losses": losses.detach(),
        "steps": torch.stack(taken),
        **dict(zip((f"gradient.{name}" for name in weights), found, strict=True)),
    }


@cache
def reference(name: str) -> dict[str, Tensor]:
    """What another package computed, as `make parity` wrote it."""
    return load_file(REFERENCE / f"{name}.safetensors")


def deviation(ours: Tensor, theirs: Tensor) -> float:
    """The largest difference, relative to the largest value."""
    assert ours.shape == theirs.shape
    return float((ours.double() - theirs.double()).abs().max() / theirs.double().abs().max())
