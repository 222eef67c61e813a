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
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy, VLAFlowMatching
from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors  # registers its steps
from references import TOLERANCE, write
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


def their_results(network: VLAFlowMatching, given: dict[str, Tensor], gradients: list[str]) -> dict[str, Tensor]:
    """Losses, named gradients, and the noisy actions before every step of sampling and after the last."""
    images, cameras = ([*given[name].unbind(1)] for name in ("images", "cameras"))
    observed = images, cameras, given["tokens"], given["sentence"], given["state"]
    losses = network(*observed, given["actions"], given["noise"], given["time"])
    losses.mean().backward()
    named, taken, denoise = dict(network.named_parameters()), list[Tensor](), network.denoise_step

    def recorded(**values: Any) -> Tensor:
        taken.append(values["x_t"])
        return denoise(**values)

    network.denoise_step = recorded
    with torch.no_grad():
        taken.append(network.sample_actions(*observed, noise=given["noise"]))
    found = {f"gradient.{name}": named[name].grad for name in gradients}
    return {"losses": losses.detach(), "steps": torch.stack(taken), **found}


def compare(name: str, ours: Tensor, theirs: Tensor) -> None:
    """Print the largest difference; fail above the tolerance."""
    off = deviation(ours, theirs)
    print(f"{name:70} {off:.1e}")
    assert off <= TOLERANCE, name


def compare_networks() -> dict[str, Tensor]:
    """Compare losses, gradients and every step of sampling; returns LeRobot's."""
    theirs, ours = their_network(trunk_config(SMOLVLA), CHUNK), SmolVLA(**SMOLVLA).eval()
    fill(theirs.named_parameters())
    fill(published(ours))
    unmatched = {name for name, _ in theirs.named_parameters()} ^ {name for name, _ in published(ours)}
    assert unmatched == {"vlm_with_expert.vlm.lm_head.weight"}, unmatched
    found = network_results(ours, inputs(SMOLVLA))
    gradients = [name.removeprefix("gradient.") for name in found if name.startswith("gradient.")]
    results = their_results(theirs, inputs(SMOLVLA), gradients)
    for name, value in results.items():
        compare(name, found[name], value)
    return results


def compare_policies(folder: Path) -> dict[str, Tensor]:
    """Compare what both do with raw observations; LeRobot's policy and processors are loaded from our export."""
    write_tokenizer(folder / "tokenizer")
    model = make_smolvla(folder / "tokenizer")
    ours = as_policy(model, SPEC)
    LeRobotPolicyExporter(folder / "exported").export(ours)
    without_hub(trunk_config(SMOLVLA))
    theirs = SmolVLAPolicy.from_pretrained(folder / "exported", strict=True)
    weights = dict(theirs.model.named_parameters())
    assert all(torch.equal(weights[name], weight) for name, weight in published(model.network))
    before, after = lerobot_modules.processors_of(folder / "exported")
    noise = torch.randn(1, CHUNK, SMOLVLA["action_width"], generator=torch.Generator().manual_seed(1))
    model.sample_noise = lambda random: noise
    executed, acted = [], []
    for number in range(PLAYED):
        seen = observation(number)
        rows = {"observation.state": torch.from_numpy(seen.state), **raw_images(seen)}
        given = before({**rows, "task": seen.instruction})
        executed.append(after(theirs.select_action(given, noise=noise))[0])
        acted.append(torch.from_numpy(ours.act(seen)))
    compare(f"{PLAYED} executed actions", torch.stack(acted), torch.stack(executed))
    results = {"policy.noise": noise, "policy.actions": torch.stack(executed)}
    return results | compare_inputs(theirs, before, model)


def raw_images(seen: Observation) -> dict[str, Tensor]:
    """Return the images of an observation as LeRobot's processors take them."""
    return {f"{IMAGES}{name}": torch.from_numpy(rgb).permute(2, 0, 1) / 255 for name, rgb in seen.rgb.items()}


def compare_inputs(theirs: SmolVLAPolicy, before: Any, model: Any) -> dict[str, Tensor]:
    """Compare images, state, tokens and actions as the networks get them."""
    seen, known = observation(0), torch.from_numpy(steps(len(SPEC.action))[:CHUNK])
    rows = {"observation.state": torch.from_numpy(seen.state), "action": known, **raw_images(seen)}
    given = [before({**rows, "task": sentence}) for sentence in SENTENCES]
    prepared, masks = theirs.prepare_images(given[0])
    assert all(mask.all() for mask in masks)
    pad = given[0]["observation.language.attention_mask"].new_tensor(-1, dtype=torch.int64)
    tokens = [
        torch.where(each["observation.language.attention_mask"], each["observation.language.tokens"], pad)
        for each in given
    ]
    results = {
        "way.images": torch.cat(prepared),
        "way.state": theirs.prepare_state(given[0]),
        "way.actions": theirs.prepare_action(given[0]).reshape(CHUNK, -1),
        "way.tokens": torch.cat(tokens),
    }
    frames = torch.stack([torch.from_numpy(seen.rgb[camera]) for camera in SPEC.cameras])
    compare("images", model.image(frames), results["way.images"])
    state = model.state_normalizer(rows["observation.state"][None])
    compare(
        "state", torch.nn.functional.pad(state, (0, SMOLVLA["state_width"] - len(SPEC.state))), results["way.state"]
    )
    compare("actions", model.scaled(known), results["way.actions"])
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
