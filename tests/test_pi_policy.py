"""π0 and π0.5 as policies: between an observation and a command, and with published weights."""

from __future__ import annotations

import json
import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import SMALL, here
from defaults import defaults_of, part_of
from safetensors.torch import load_file, save_file
from tiny_pi import (
    KINDS,
    SIZES,
    SPEC,
    STATISTICS,
    batch_of,
    export,
    make_network,
    make_policy,
    observed,
    take_statistics,
    write_tokenizer,
)
from tiny_vla import REFERENCE, deviation, published, reference
from torch import Tensor

from vla.config.compose import compose
from vla.io.errors import UserError
from vla.models.tokenizers.tokenizer import Uniform
from vla.models.vlm.network import rename_weight
from vla.models.vlm.policy import VisionLanguageAction, last_values
from vla.models.vlm.prompt import PADDING, WORDS, Prompt
from vla.models.vlm.smolvla import SmolVLA

TOLERANCE = 1e-5
each = pytest.mark.parametrize("name", KINDS)


@pytest.mark.parametrize(("name", "file"), [("pi0", "pi0_policy"), ("pi05", "pi05")])
def test_the_way_from_observations_to_commands_is_that_of_lerobot(name: str, file: str, tmp_path: Path) -> None:
    model, given, theirs = make_policy(name, write_tokenizer(tmp_path)), observed(), reference(file)
    take_statistics(model)
    state, batch = model.state_normalizer(given["state"]), batch_of(model)
    tokens, sentence = model.text(batch["text"], state), theirs["way.sentence"].bool()
    assert torch.equal(tokens != PADDING, sentence) and torch.equal(tokens[sentence], theirs["way.tokens"][sentence])
    assert sentence[0].all() and not sentence[1].all()  # one prompt is cut, the other is not
    assert deviation(state, theirs["way.state"]) < TOLERANCE
    assert deviation(model.scaled(given["actions"]), theirs["way.actions"]) < TOLERANCE
    assert deviation(model.image(given["images"][0]), theirs["way.image"]) < TOLERANCE
    assert theirs["way.present"].tolist() == [[True, True, False]] * 2  # a third camera is missing there
    with torch.no_grad():
        assert deviation(model.predict(batch).actions, theirs["way.commands"]) < TOLERANCE


@pytest.mark.parametrize("name", [*KINDS, "smolvla"])
def test_names_and_shapes_are_those_that_are_published(name: str) -> None:
    listed = json.loads((REFERENCE / f"{name}_base.json").read_text())
    shapes = dict[str, list[int]]()
    for weight, layers, shape in listed["weights"]:
        for number in range(*map(int, layers.split(":"))) if layers else [0]:
            shapes[weight.replace("*", str(number))] = shape
    assert len(shapes) == listed["tensors"] == {"pi0": 777, "pi05": 812, "smolvla": 500}[name]
    assert sum(map(math.prod, shapes.values())) == listed["numbers"]
    arguments = {key: value for key, value in compose(f"model={name}").model.network.items() if key[0] != "_"}
    with torch.device("meta"):
        network = {**KINDS, "smolvla": SmolVLA}[name](**arguments)
    ours = {weight: [*tensor.shape] for weight, tensor in network.named_parameters()}
    used = {weight: shape for weight, shape in shapes.items() if not weight.startswith(network.unused_names)}
    assert {rename_weight(weight, network.published_names): shape for weight, shape in used.items()} == ours
    assert len(used) == len(ours)  # no two are one
    head = "model.vlm_with_expert.vlm" if name == "smolvla" else "paligemma_with_expert.gemma_expert"
    assert shapes.keys() - used.keys() == {f"{head}.lm_head.weight"}


@each
def test_what_is_exported_has_every_name_that_is_published(name: str, tmp_path: Path) -> None:
    """Otherwise LeRobot's classes say that it could not be loaded."""
    export(name, tmp_path)
    written, head = load_file(tmp_path / "exported/model.safetensors"), "paligemma_with_expert.gemma_expert.lm_head."
    ours = dict(published(make_network(name)))
    assert written.keys() == {f"model.{weight}" for weight in (*ours, f"{head}weight")}
    assert written[f"model.{head}weight"].shape == (SIZES["vocabulary"], SIZES["expert_width"])
    assert all(torch.equal(written[f"model.{weight}"], tensor) for weight, tensor in ours.items())


def write_published(folder: Path, name: str) -> dict[str, Tensor]:
    """Write a folder as LeRobot publishes it, with the weights of `make_network`; returns those."""
    weights = {weight: tensor.detach().clone() for weight, tensor in published(make_network(name))}
    unused = {"paligemma_with_expert.gemma_expert.lm_head.weight": torch.ones(SIZES["vocabulary"], 4)}
    head = "model." if name == "pi05" else ""  # both are found
    saved = {head + weight: tensor for weight, tensor in {**weights, **unused}.items()}
    save_file(saved, folder / "model.safetensors")
    images = {f"observation.images.{camera}": {"type": "VISUAL", "shape": [3, 28, 28]} for camera in SPEC.cameras}
    features = {**images, "observation.state": {"type": "STATE", "shape": [5]}}
    config = {"type": name, "input_features": features, "output_features": {"action": {"type": "ACTION", "shape": [5]}}}
    (folder / "config.json").write_text(json.dumps(config))
    file = "policy_preprocessor_step_2_normalizer_processor.safetensors"
    steps = [{"registry_name": "normalizer_processor", "config": {}, "state_file": file}]
    (folder / "policy_preprocessor.json").write_text(json.dumps({"name": "policy_preprocessor", "steps": steps}))
    given = observed()
    statistics = {
        f"{feature}.{kind}": given[f"{feature.rpartition('.')[2]}.{quantile}"]
        for feature in ("observation.state", "action")
        for kind, quantile in zip(STATISTICS[name], ("q01", "q99"), strict=True)
    }
    save_file(statistics, folder / file)
    return weights


@each
def test_published_weights_and_statistics_are_loaded_and_a_missing_weight_is_named(name: str, tmp_path: Path) -> None:
    weights = write_published(tmp_path, name)
    text = write_tokenizer(tmp_path)
    model = make_policy(name, text, trunk=str(tmp_path), statistics="pretrained")
    loaded = dict(published(model.network))
    assert loaded.keys() == weights.keys()
    assert all(torch.equal(tensor, weights[weight]) for weight, tensor in loaded.items())
    other = make_policy(name, text)
    with torch.no_grad():
        assert not torch.equal(model.predict(batch_of(model)).actions, other.predict(batch_of(other)).actions)
        other.state_normalizer.load_state_dict(model.state_normalizer.state_dict())
        other.action_normalizer.load_state_dict(model.action_normalizer.state_dict())
        assert torch.equal(model.predict(batch_of(model)).actions, other.predict(batch_of(other)).actions)
    saved = load_file(tmp_path / "model.safetensors")
    lost = next(weight for weight in saved if "lm_head" not in weight)
    save_file({weight: tensor for weight, tensor in saved.items() if weight != lost}, tmp_path / "model.safetensors")
    with pytest.raises(
        UserError, match=f"lacks weights of the model: {re.escape(rename_weight(lost, model.network.published_names))}$"
    ):
        make_policy(name, text, trunk=str(tmp_path))


def test_it_trains_and_is_evaluated_and_saved_like_any_other_model(home: Path) -> None:
    sizes = {**SIZES, "vocabulary": 4096, "action_width": 32}
    network = [f"model.network.{key}={value}" for key, value in sizes.items()]
    tiny = ["model.text.name=null", "model.text.length=160", "model.chunk=8", "model.steps=2", "trainer.max_steps=2"]
    here(home, *SMALL, "model=pi05", *network, *tiny, "output=pi05", "hydra.run.dir=pi05")
    assert json.loads((home / "pi05/policy/config.json").read_text())["model"]["chunk"] == 8
    assert (home / "pi05/policy/model.safetensors").is_file() and list((home / "pi05").rglob("report.json"))


def test_a_network_that_reads_the_state_in_the_sentence_is_trained_without_it_if_asked(
    caplog: pytest.LogCaptureFixture,
) -> None:
    options = {**part_of("model/pi05", "text", name=None, length=20), "state": False}
    network = partial(make_network, "pi05", vocabulary=WORDS)
    tokenizer = Uniform(spec=SPEC, **defaults_of("tokenizer/uniform"))
    model = VisionLanguageAction(
        *(network, partial(Prompt, **options)), **defaults_of("model/pi05"), spec=SPEC, tokenizer=tokenizer
    )
    take_statistics(model)
    assert not caplog.records  # of a policy that acts
    model.fit(np.zeros((2, len(SPEC.state)), np.float32), np.zeros((2, len(SPEC.action)), np.float32))
    assert "PI05 sees the state in the sentence only, and it is not there: model.text.state=true" in caplog.text
    one = batch_of(model)
    other = {**one, "state": one["state"] + 1}
    with torch.no_grad():
        assert torch.equal(model.predict(one).actions, model.predict(other).actions)


def test_what_actions_see_of_a_prompt_does_not_end_with_its_padding(tmp_path: Path) -> None:
    model = make_policy("pi05", write_tokenizer(tmp_path))
    take_statistics(model)
    with torch.no_grad():
        together = model.encode_prefix(batch_of(model))
    lengths = together.present.sum(1)
    assert lengths[0] != lengths[1]
    for number, seen in enumerate(last_values(together)):
        assert torch.equal(seen, together.values[-1][number, :, lengths[number] - 1].flatten())
