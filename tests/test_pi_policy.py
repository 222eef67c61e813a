"""π0 and π0.5 as policies: between an observation and a command, and with published weights."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from defaults import defaults_of, part_of
from safetensors.torch import save_file
from tiny_pi import (
    CHUNK,
    LENGTH,
    SIZES,
    STATE_WIDTH,
    TASKS,
    observed,
    published_name,
    published_weights,
    write_tokenizer,
)
from tiny_vla import REFERENCE, deviation, fill, reference
from torch import Tensor

from vla.io.errors import UserError
from vla.models.tokenizers.tokenizer import Uniform
from vla.models.vlm.network import FlowNetwork
from vla.models.vlm.pi0 import PI0
from vla.models.vlm.pi05 import PI05
from vla.models.vlm.policy import VisionLanguageAction
from vla.models.vlm.prompt import PADDING, Prompt
from vla.spec import Spec

COMPONENTS = ("x", "y", "z", "yaw", "gripper")
SPEC = Spec(
    cameras=("front", "side"),
    image_size=(36, 48),
    state=COMPONENTS,
    state_units=("m", "m", "m", "rad", "m"),
    action=COMPONENTS,
    units=("m", "m", "m", "rad", "1"),
    low=(-1.0,) * 5,
    high=(1.0,) * 5,
    control_hz=10.0,
)
KINDS: dict[str, type[FlowNetwork]] = {"pi0": PI0, "pi05": PI05}
WIDTHS: dict[str, dict[str, Any]] = {"pi0": {"state_width": STATE_WIDTH}, "pi05": {}}
TOLERANCE = 1e-5
each = pytest.mark.parametrize("name", KINDS)


def made(name: str, tokenizer: Path | None = None, **options: Any) -> VisionLanguageAction:
    """The policy of an option with a tiny network."""
    text = part_of(f"model/{name}", "text", name=tokenizer and str(tokenizer), length=LENGTH)
    return VisionLanguageAction(
        partial(KINDS[name], **SIZES, **WIDTHS[name]),
        partial(Prompt, **text),
        **defaults_of(f"model/{name}", chunk=CHUNK, **options),
        spec=SPEC,
        tokenizer=Uniform(spec=SPEC, **defaults_of("tokenizer/uniform")),
    ).eval()


def batch_of(model: VisionLanguageAction, given: dict[str, Tensor]) -> dict[str, Any]:
    """What the policy is given of the observations."""
    return {
        "rgb": {camera: images.unsqueeze(1) for camera, images in zip(SPEC.cameras, given["images"], strict=True)},
        "state": given["state"].unsqueeze(1),
        "present": torch.ones(len(TASKS), 1, dtype=torch.bool),
        "text": model.text.tokenize([*TASKS]),
        "noise": given["noise"],
    }


def test_the_way_from_observations_to_commands_is_that_of_lerobot(tmp_path: Path) -> None:
    model, given, theirs = made("pi05", write_tokenizer(tmp_path)), observed(), reference("pi05")
    fill(published_weights(model.network))
    for normalizer, name in ((model.state_normalizer, "state"), (model.action_normalizer, "action")):
        normalizer.take({f"{name}.{each}": given[f"{name}.{each}"] for each in ("q01", "q99")}, name, "the reference")
    state, batch = model.state_normalizer(given["state"]), batch_of(model, given)
    tokens, sentence = model.text(batch["text"], state), theirs["way.sentence"].bool()
    assert torch.equal(tokens != PADDING, sentence) and torch.equal(tokens[sentence], theirs["way.tokens"][sentence])
    assert sentence[0].all() and not sentence[1].all()  # one prompt is cut, the other is not
    assert deviation(state, theirs["way.state"]) < TOLERANCE
    assert deviation(model.padded(given["actions"]), theirs["way.actions"]) < TOLERANCE
    assert deviation(model.image(given["images"][0]), theirs["way.image"]) < TOLERANCE
    assert theirs["way.present"].tolist() == [[True, True, False]] * 2  # their third camera is missing
    with torch.no_grad():
        assert deviation(model.predict(batch).actions, theirs["way.commands"]) < TOLERANCE


def listed(name: str) -> dict[str, tuple[int, ...]]:
    """Name → shape of the published weights."""
    shapes = dict[str, tuple[int, ...]]()
    for pattern, shape in json.loads((REFERENCE / f"{name}_names.json").read_text())["shapes"].items():
        layers = re.search(r"{(\d+)}", pattern)
        for number in range(int(layers[1])) if layers else (0,):
            shapes[re.sub(r"{\d+}", str(number), pattern)] = tuple(shape)
    return shapes


@each
def test_weights_are_one_to_one_those_that_are_published(name: str) -> None:
    published = listed(name)
    assert len(published) == {"pi0": 777, "pi05": 812}[name]
    with torch.device("meta"):
        network = KINDS[name](**part_of(f"model/{name}", "network"))
    ours = {weight: tuple(tensor.shape) for weight, tensor in published_weights(network)}
    assert ours == {weight: shape for weight, shape in published.items() if not weight.startswith(network.unused)}


def write_published(folder: Path, name: str, without: str = "") -> dict[str, Tensor]:
    """Write a folder as LeRobot publishes it, with random weights, but for one of them; returns those."""
    network = KINDS[name](**SIZES, **WIDTHS[name])
    fill(published_weights(network))
    weights = {weight: tensor.clone() for weight, tensor in published_weights(network)}
    unused = {"paligemma_with_expert.gemma_expert.lm_head.weight": torch.ones(SIZES["vocabulary"], 4)}
    head = "model." if name == "pi05" else ""  # both are found
    saved = {head + weight: tensor for weight, tensor in {**weights, **unused}.items() if weight != without}
    save_file(saved, folder / "model.safetensors")
    cameras = {f"observation.images.{camera}": {"type": "VISUAL", "shape": [3, 28, 28]} for camera in SPEC.cameras}
    features = {**cameras, "observation.state": {"type": "STATE", "shape": [5]}}
    config = {"type": name, "input_features": features, "output_features": {"action": {"type": "ACTION", "shape": [5]}}}
    (folder / "config.json").write_text(json.dumps(config))
    step = {
        "registry_name": "normalizer_processor",
        "config": {},
        "state_file": "policy_preprocessor_step_2.safetensors",
    }
    (folder / "policy_preprocessor.json").write_text(json.dumps({"name": "policy_preprocessor", "steps": [step]}))
    given = observed()
    kinds = ("mean", "std") if name == "pi0" else ("q01", "q99")
    statistics = {
        f"{feature}.{kind}": given[f"{feature.rpartition('.')[2]}.{quantile}"]
        for feature in ("observation.state", "action")
        for kind, quantile in zip(kinds, ("q01", "q99"), strict=True)
    }
    save_file(statistics, folder / step["state_file"])
    return weights


@each
def test_published_weights_and_statistics_are_loaded(name: str, tmp_path: Path) -> None:
    weights = write_published(tmp_path, name)
    model = made(name, trunk=str(tmp_path), statistics="pretrained")
    for weight, tensor in model.network.state_dict().items():
        assert torch.equal(tensor, weights[published_name(KINDS[name], weight).removeprefix("model.")])
    other = made(name)
    fill(published_weights(other.network))
    other.state_normalizer.load_state_dict(model.state_normalizer.state_dict())
    other.action_normalizer.load_state_dict(model.action_normalizer.state_dict())
    assert not torch.equal(other.action_normalizer(torch.zeros(5)), made(name).action_normalizer(torch.zeros(5)))
    given = batch_of(model, observed())
    with torch.no_grad():
        assert torch.equal(model.predict(given).actions, other.predict(given).actions)


@each
def test_a_missing_weight_is_named(name: str, tmp_path: Path) -> None:
    weight = "paligemma_with_expert.gemma_expert.model.layers.1.mlp.up_proj.weight"
    write_published(tmp_path, name, without=weight)
    with pytest.raises(UserError, match=r"lacks expert\.layers\.1\.mlp\.up_proj\.weight"):
        made(name, trunk=str(tmp_path))
