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

from vla.deploy.export_policy import Act, Encode, ProgramExporter, capture
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
    from onnxruntime import InferenceSession

    policy = as_policy(make())
    folder = ProgramExporter(tmp_path / "program", onnx=True).export_policy(policy)
    report = json.loads((folder / "program.json").read_text())
    assert report["spec"] == SPEC.to_dict()
    assert all(run["difference"] < 1e-3 and run["ms"] > 0 for run in report["act"]["runs"].values())
    assert set(report["act"]["runs"]) == {"model", "act.pt2", "act.onnx"}
    encoders = {"encode.pt2", "encode.onnx"} if "encode" in report else set()
    assert {path.name for path in folder.iterdir()} == {"act.pt2", "act.onnx", "program.json", *encoders}
    assert bool(encoders) == isinstance(policy.model, (RT1, Decoder))
    if isinstance(policy.model, RT1):  # which keeps tokens, and so encodes one frame at a time
        assert report["encode"]["inputs"]["eye"] == {"dtype": "uint8", "shape": [1, 1, *SPEC.image_size, 3]}
        assert report["act"]["inputs"]["tokens"]["shape"] == [1, 3, 4, 32]

    observation = ToyEnvironment().reset(0)
    instruction = "please do something that takes a good many more words than the example had"
    policy.reset(instruction, 0)
    observation = replace(observation, instruction=instruction)
    expected = policy.plan(observation)
    window, drawn = policy.window(), policy.model.sample_noise(torch.Generator().manual_seed(0))
    inputs = {**window.pop("rgb"), **window, **({} if drawn is None else {"noise": drawn})}
    loaded = torch.export.load(folder / "act.pt2").module()
    session = InferenceSession(folder / "act.onnx")
    given = {node.name: inputs[node.name].numpy() for node in session.get_inputs()}
    with torch.inference_mode():
        outputs = loaded(inputs).numpy(), session.run(None, given)[0]
    for actions in outputs:
        assert np.clip(actions[0], SPEC.low, SPEC.high) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("program", "wrong"), [("Encode", float("nan")), ("Act", 0.01)])
def test_a_program_that_differs_is_not_written(
    program: str, wrong: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def captured(whole: Encode | Act, inputs: dict[str, Tensor]) -> ExportedProgram:
        if type(whole).__name__ != program:
            return capture(whole, inputs)
        changed = type(whole)(deepcopy(whole.model))
        bias = changed.model.context.image_tokens.bias if program == "Encode" else changed.model.head.bias  # type: ignore[union-attr]
        with torch.no_grad():
            bias[0] += 1000 * wrong  # type: ignore[index,operator]
        return capture(changed, inputs)

    monkeypatch.setattr("vla.deploy.export_policy.capture", captured)
    with pytest.raises(ValueError, match=r"\.pt2 differs from the model"):
        ProgramExporter(tmp_path / "program", onnx=False).export_policy(as_policy(make_rt1(layers=1)))
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "program").mkdir()
    with pytest.raises(ValueError, match=r"exists already: choose another export\.folder"):
        ProgramExporter(tmp_path / "program", onnx=True).export_policy(as_policy(make_bc()))
    assert [path.name for path in tmp_path.iterdir()] == ["program"]
