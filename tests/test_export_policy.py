"""Exported programs give the outputs of the model."""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from defaults import defaults_of
from fake_batch import as_policy, make_bc, make_decoder, make_denoising, make_rt1
from torch import Tensor
from torch.export import ExportedProgram
from toy import SPEC, ToyEnvironment

from vla.deploy.onnx_policy import Program, ProgramExporter, capture, inputs_of, open_onnx
from vla.models.decoder import Decoder
from vla.models.diffusion import Diffusion
from vla.models.model import Model
from vla.models.rt1 import RT1
from vla.models.text.ngrams import NGrams

pytestmark = pytest.mark.usefixtures("faster_exports")


@pytest.mark.parametrize(  # models with short programs
    "make",
    [
        lambda: make_bc(chunk=2),
        lambda: make_bc(text=partial(NGrams, **defaults_of("model/text/known_words"))),
        lambda: make_rt1(proprioception=True, layers=1),
        lambda: make_decoder(layers=1),
        lambda: make_denoising(Diffusion, layers=1, steps=2),
    ],
    ids=["bc", "known words", "rt1 with kept tokens", "decoder", "diffusion"],
)
def test_the_programs_act_like_the_policy_for_any_instruction(make: Callable[[], Model], tmp_path: Path) -> None:
    policy = as_policy(make())
    folder = ProgramExporter(tmp_path / "program").export(policy)
    report = json.loads((folder / "program.json").read_text())
    assert report["spec"] == SPEC.to_dict() and report["act"]["difference"] < 1e-3
    encoders = {"encode.onnx"} if "encode" in report else set()
    assert {path.name for path in folder.iterdir()} == {"act.onnx", "program.json", *encoders}
    assert bool(encoders) == isinstance(policy.model, (RT1, Decoder))
    if isinstance(policy.model, RT1):  # which keeps tokens, and so encodes one frame at a time
        assert report["encode"]["inputs"]["eye"] == {"dtype": "uint8", "shape": [1, 1, *SPEC.image_size, 3]}
        assert report["act"]["inputs"]["tokens"]["shape"] == [1, 3, 4, 32]

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
        ProgramExporter(tmp_path / "program").export(as_policy(make_rt1(layers=1)))
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "program").mkdir()
    with pytest.raises(ValueError, match=r"exists already: choose another export\.folder"):
        ProgramExporter(tmp_path / "program").export(as_policy(make_bc()))
    assert [path.name for path in tmp_path.iterdir()] == ["program"]
