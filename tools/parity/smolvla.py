"""Compares SmolVLA with LeRobot's own, of equal weights, noise and times, and writes what the tests compare with.

    PYTHONPATH=FOLDER_OF_LEROBOT:.:tests python tools/parity/smolvla.py

Three things are compared: the network; the way from raw observations to executed actions, for which LeRobot loads a
policy that was exported here; and what LeRobot's processors make of every input on that way.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lerobot_modules  # first: it makes the imports of LeRobot possible
import torch
from fake_batch import as_policy
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors  # registers its steps
from references import TOLERANCE, lerobot_results, write
from smolvla_peer import their_network, without_hub
from tiny_vla import (
    CHUNK,
    SENTENCES,
    SMOLVLA,
    SPEC,
    deviation,
    fill,
    inputs,
    make_smolvla,
    network_results,
    observation,
    published,
    steps,
    write_tokenizer,
)
from torch import Tensor
from transformers import SmolVLMConfig

from vla.models.vlm.lerobot_export import LeRobotPolicyExporter
from vla.models.vlm.smolvla import SmolVLA
from vla.models.vlm.trunk import IMAGES
from vla.spec import Observation

assert make_smolvla_pre_post_processors
PLAYED = 7  # observations, of two chunks


def trunk_config(sizes: dict[str, Any]) -> SmolVLMConfig:
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


def compare(name: str, ours: Tensor, theirs: Tensor) -> None:
    """Print the largest difference; fail above the tolerance."""
    error = deviation(ours, theirs)
    print(f"{name:70} {error:.1e}")
    assert error <= TOLERANCE, name


def compare_networks() -> dict[str, Tensor]:
    """Compare losses, gradients and every step of sampling; returns LeRobot's."""
    reference, network = their_network(trunk_config(SMOLVLA), CHUNK), SmolVLA(**SMOLVLA).eval()
    fill(reference.named_parameters())
    fill(published(network))
    unmatched_names = {name for name, _ in reference.named_parameters()} ^ {name for name, _ in published(network)}
    assert unmatched_names == {"vlm_with_expert.vlm.lm_head.weight"}, unmatched_names
    our_results = network_results(network, inputs(SMOLVLA))
    gradients = [name.removeprefix("gradient.") for name in our_results if name.startswith("gradient.")]
    names = ("tokens", "sentence", "state")
    results = lerobot_results(reference, names, inputs(SMOLVLA), {name: name for name in gradients})
    for name, value in results.items():
        compare(name, our_results[name], value)
    return results


def compare_policies(folder: Path) -> dict[str, Tensor]:
    """Compare what both do with raw observations; LeRobot's policy and processors are loaded from our export."""
    write_tokenizer(folder / "tokenizer")
    model = make_smolvla(folder / "tokenizer")
    policy = as_policy(model, SPEC)
    LeRobotPolicyExporter(folder / "exported").export(policy)
    without_hub(trunk_config(SMOLVLA))
    reference = SmolVLAPolicy.from_pretrained(folder / "exported", strict=True)
    weights = dict(reference.model.named_parameters())
    assert all(torch.equal(weights[name], weight) for name, weight in published(model.network))
    preprocess, postprocess = lerobot_modules.processors_of(folder / "exported")
    noise = torch.randn(1, CHUNK, SMOLVLA["action_width"], generator=torch.Generator().manual_seed(1))
    model.sample_noise = lambda random: noise
    their_actions, our_actions = [], []
    for number in range(PLAYED):
        step = observation(number)
        rows = {"observation.state": torch.from_numpy(step.state), **raw_images(step)}
        batch = preprocess({**rows, "task": step.instruction})
        their_actions.append(postprocess(reference.select_action(batch, noise=noise))[0])
        our_actions.append(torch.from_numpy(policy.act(step)))
    compare(f"{PLAYED} executed actions", torch.stack(our_actions), torch.stack(their_actions))
    results = {"policy.noise": noise, "policy.actions": torch.stack(their_actions)}
    return results | compare_inputs(reference, preprocess, model)


def raw_images(seen: Observation) -> dict[str, Tensor]:
    """Return the images of an observation as LeRobot's processors take them."""
    return {f"{IMAGES}{name}": torch.from_numpy(rgb).permute(2, 0, 1) / 255 for name, rgb in seen.rgb.items()}


def compare_inputs(theirs: SmolVLAPolicy, before: Any, model: Any) -> dict[str, Tensor]:
    """Compare images, state, tokens and actions as the networks get them."""
    step, actions = observation(0), torch.from_numpy(steps(len(SPEC.action))[:CHUNK])
    rows = {"observation.state": torch.from_numpy(step.state), "action": actions, **raw_images(step)}
    batches = [before({**rows, "task": sentence}) for sentence in SENTENCES]
    images, masks = theirs.prepare_images(batches[0])
    assert all(mask.all() for mask in masks)
    pad = batches[0]["observation.language.attention_mask"].new_tensor(-1, dtype=torch.int64)
    tokens = [
        torch.where(batch["observation.language.attention_mask"], batch["observation.language.tokens"], pad)
        for batch in batches
    ]
    results = {
        "way.images": torch.cat(images),
        "way.state": theirs.prepare_state(batches[0]),
        "way.actions": theirs.prepare_action(batches[0]).reshape(CHUNK, -1),
        "way.tokens": torch.cat(tokens),
    }
    frames = torch.stack([torch.from_numpy(step.rgb[camera]) for camera in SPEC.cameras])
    compare("images", model.image(frames), results["way.images"])
    state = model.state_normalizer(rows["observation.state"][None])
    compare(
        "state", torch.nn.functional.pad(state, (0, SMOLVLA["state_width"] - len(SPEC.state))), results["way.state"]
    )
    compare("actions", model.scaled(actions), results["way.actions"])
    assert torch.equal(model.text.tokenize([*SENTENCES]), results["way.tokens"])
    return results


def main() -> None:
    """Compare everything, and write the reference."""
    results = compare_networks()
    with TemporaryDirectory() as folder:
        results |= compare_policies(Path(folder))
    write("smolvla", results)


if __name__ == "__main__":
    main()
