"""A policy that runs ONNX programs acts like the one that runs the model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composing import composed
from defaults import defaults_of
from fake_batch import as_policy, make_bc, make_decoder, make_denoising, make_rt1
from observing import act, observations
from torch import Tensor
from torch.export import ExportedProgram
from toy import SPEC, ToyEnvironment

from vla.config.experiment import Experiment
from vla.deploy.onnx_policy import OnnxPolicy, Program, capture, inputs_of, open_onnx, write_programs
from vla.models.decoder import Decoder
from vla.models.diffusion import Diffusion
from vla.models.flow import Flow
from vla.models.model import Model
from vla.models.text.ngrams import NGrams
from vla.models.tokenizers.fast import Fast

pytestmark = pytest.mark.usefixtures("faster_exports")
RANGE = np.subtract(SPEC.high, SPEC.low)


def as_onnx(model: Model, folder: Path, **options: Any) -> OnnxPolicy:
    return OnnxPolicy(**defaults_of("policy/onnx", **{"folder": folder, **options}), model=model, spec=SPEC)


@pytest.fixture(scope="module")
def flow(tmp_path_factory: pytest.TempPathFactory) -> tuple[Model, Path]:
    """A model, and the folder of its programs."""
    model, folder = make_denoising(Flow, layers=1, steps=2), tmp_path_factory.mktemp("flow")
    as_onnx(model, folder)
    return model, folder


@pytest.fixture
def rt1(tmp_path: Path) -> tuple[Model, Path]:
    """A model, and where its programs go."""
    return make_rt1(keypoints=0, proprioception=True, chunk=2, layers=1), tmp_path


@pytest.mark.parametrize("kind", ["rt1", "flow"])
def test_it_acts_like_the_model_through_two_instructions(kind: str, request: pytest.FixtureRequest) -> None:
    """With a history that fills and is cleared, chunks that are executed, and noise."""
    model, folder = request.getfixturevalue(kind)
    seen = observations(5)
    seen += [replace(each, instruction="now something else, in a few more words") for each in seen]
    exact, onnx = as_policy(model), as_onnx(model, folder)
    for policy in (exact, onnx):
        policy.reset(seen[0].instruction, 1)
    expected = act(exact, seen)
    assert np.abs(np.diff(expected, axis=0)).max() > 1e-3  # they depend on the observations
    assert (np.abs(act(onnx, seen) - expected) / RANGE).max() < 1e-3
    onnx.reset(seen[0].instruction, 1, 1)
    other = np.concatenate([onnx.act([each], [1]) for each in seen[:5]])
    assert (np.abs(other - expected[:5]) / RANGE).max() < 1e-3
    if kind == "rt1":  # which keeps tokens, and so encodes one frame at a time
        report = json.loads(next(folder.glob("*/program.json")).read_text())
        assert report["encode"]["inputs"]["eye"] == {"dtype": "uint8", "shape": [1, 1, *SPEC.image_size, 3]}
        assert report["act"]["inputs"]["tokens"]["shape"] == [1, 3, 3, 32]


def test_programs_are_exported_once_for_the_same_weights_and_options(
    flow: tuple[Model, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = deepcopy(flow[0])
    shutil.copytree(flow[1], tmp_path, dirs_exist_ok=True)
    (programs,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert {path.name for path in programs.iterdir()} == {"act.onnx", "program.json"}

    (programs / "act.onnx").write_bytes(b"torn")
    with pytest.raises(ValueError, match=r"act\.onnx is damaged: delete its folder"):
        as_onnx(model, tmp_path)

    exported = []
    monkeypatch.setattr("vla.deploy.onnx_policy.write_programs", lambda *arguments: exported.append(arguments[1]))
    monkeypatch.setattr("vla.deploy.onnx_policy.open_onnx", lambda path: path)
    as_onnx(model, tmp_path)
    assert exported == []
    model.temperature *= 2  # type: ignore[operator]
    as_onnx(model, tmp_path)
    with torch.no_grad():
        next(model.parameters())[0] += 1
    as_onnx(model, tmp_path)
    assert len({programs, *exported}) == 3


def test_a_checkpoint_acts_through_its_programs(home: Path, tmp_path: Path) -> None:
    asked = composed(f"checkpoint={home}/run", "policy=onnx", f"policy.folder={tmp_path}")
    onnx: Any = Experiment.from_config(asked).make_policy()()
    assert onnx.act(onnx.spec.random_observation(np.random.default_rng(0))).shape == (len(onnx.spec.action),)
    assert onnx.lanes == 1  # a server plans for one client at a time


def test_a_model_that_cannot_be_exported_is_named(tmp_path: Path) -> None:
    tokenizer = Fast(spec=SPEC, **defaults_of("tokenizer/fast", chunk=4))
    with pytest.raises(ValueError, match="Decoder with Fast cannot be exported"):
        as_onnx(make_decoder(chunk=4, tokenizer=tokenizer, layers=1), tmp_path)
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []


@pytest.mark.parametrize(  # models with short programs
    "make",
    [
        lambda: make_bc(chunk=2, text=partial(NGrams, **defaults_of("model/text/known_words"))),
        lambda: make_decoder(layers=1),
        lambda: make_denoising(Diffusion, layers=1, steps=2),
    ],
    ids=["bc with known words", "decoder", "diffusion"],
)
def test_the_programs_act_like_the_policy_for_any_instruction(make: Callable[[], Model], tmp_path: Path) -> None:
    policy = as_policy(make())
    write_programs(policy, folder := tmp_path / "program")
    report = json.loads((folder / "program.json").read_text())
    assert report["spec"] == SPEC.to_dict() and report["act"]["difference"] < 1e-3
    encoders = {"encode.onnx"} if "encode" in report else set()
    assert {path.name for path in folder.iterdir()} == {"act.onnx", "program.json", *encoders}
    assert bool(encoders) == isinstance(policy.model, Decoder)

    instruction = "please do something that takes a good many more words than the example had"
    policy.reset(instruction, 0)
    expected = policy.plan(replace(ToyEnvironment().reset(0), instruction=instruction))
    window, drawn = policy.window(), policy.model.sample_noise(torch.Generator().manual_seed(0))
    inputs = inputs_of(window if drawn is None else {**window, "noise": drawn})
    actions = open_onnx(folder / "act.onnx")(inputs).numpy()
    assert np.clip(actions[0], SPEC.low, SPEC.high) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("program", "wrong"), [("encode", float("nan")), ("act", 0.01)])
def test_a_program_that_differs_is_not_written(
    program: str, wrong: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def captured(whole: Program, inputs: dict[str, Tensor]) -> ExportedProgram:
        if whole.part != program:
            return capture(whole, inputs)
        changed = Program(deepcopy(whole.model), whole.part)
        bias = changed.model.context.image_tokens.bias if program == "encode" else changed.model.head.bias  # type: ignore[union-attr]
        with torch.no_grad():
            bias[0] += 1000 * wrong  # type: ignore[index,operator]
        return capture(changed, inputs)

    monkeypatch.setattr("vla.deploy.onnx_policy.capture", captured)
    with pytest.raises(ValueError, match=r"\.onnx differs from the model"):
        write_programs(as_policy(make_rt1(layers=1)), tmp_path / "program")
    assert not list(tmp_path.iterdir())
