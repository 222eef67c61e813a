"""A trained policy as programs that run without this project: torch.export, and ONNX."""

# T frames of history, N tokens per frame, E width of a token, L tokens of a sentence, k action chunk, D components

from __future__ import annotations

import io
import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from vla.files import atomic_path
from vla.models.model import Batch, Model
from vla.policy import Policy, noise
from vla.types import Text

log = logging.getLogger(__name__)

Inputs = dict[str, Tensor]
Run = Callable[[Inputs], Tensor]

TOLERANCE = 1e-3  # largest difference between what a program and the model give [range of it]
SENTENCES = ("lift it", "put the small green block on the blue pad")  # of different lengths


class Encode(nn.Module):
    """One frame → what is kept of it: (1, 1, N, E).

    Args:
        model: one that keeps tokens.
    """

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model

    def forward(self, inputs: Inputs) -> Tensor:
        """Named inputs: each camera's (1, 1, H, W, 3) uint8, proprio (1, 1, P), present (1, 1) bool, text (1, L)."""
        tokens = self.model.encode(_batch(self.model, inputs))
        assert tokens is not None
        return tokens


class Act(nn.Module):
    """A window of frames → the actions after its newest one: (1, k, D), not yet clipped to the bounds of the spec.

    Args:
        model: any.
    """

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model

    def forward(self, inputs: Inputs) -> Tensor:
        """Named inputs: tokens (1, T, N, E), or T frames of what `Encode` takes; present (1, T) and text (1, L); of a
        model that draws its actions noise too, (1, k, D) standard normal."""
        return self.model.predict(_batch(self.model, inputs)).actions


class Program:
    """Writes a trained policy as `act.pt2` and `act.onnx`, and as `encode.…` where the model keeps tokens of a frame.

    Each program then plays an episode of noise beside the model; `program.json` says what goes in, how much the two
    differ and how long a step takes. The folder appears when all of it is there.

    Args:
        folder: where to write; must not exist.
        onnx: whether to write ONNX too, which needs the extra `onnx`.
    """

    def __init__(self, folder: Text | Path, onnx: bool = True) -> None:
        self._folder, self._onnx = Path(folder).resolve(), onnx

    def export(self, policy: Policy) -> Path:
        """Write the programs of a policy, for the CPU and in 32 bits, whatever it computes on; returns the folder.

        Raises:
            ValueError: the folder exists, ONNX is not installed, or a program does not do what the model does.
        """
        if self._folder.exists():
            raise ValueError(f"{self._folder} exists already: choose another export.folder")
        if self._onnx:
            _require_onnx()
        with atomic_path(self._folder) as draft:
            draft.mkdir(parents=True)
            told = self._write(draft, Policy("cpu", model=policy.model, spec=policy.spec))
            (draft / "program.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        return self._folder

    def _write(self, folder: Path, policy: Policy) -> dict[str, Any]:
        model, span = policy.model, torch.tensor(np.subtract(policy.spec.high, policy.spec.low), dtype=torch.float32)
        told: dict[str, Any] = {"model": type(model).__name__, "spec": policy.spec.to_dict()}
        for name, steps in played(policy).items():
            whole = (Act if name == "act" else Encode)(model)
            captured = capture(whole, steps[0])
            archive = io.BytesIO()
            torch.export.save(captured, archive)
            (folder / f"{name}.pt2").write_bytes(archive.getbuffer())  # torch would hide what the disk says
            runs: dict[str, Run] = {"model": whole, f"{name}.pt2": torch.export.load(folder / f"{name}.pt2").module()}
            if self._onnx:
                runs[f"{name}.onnx"] = write_onnx(captured, steps[0], folder / f"{name}.onnx")
            measures = compared(runs, steps, span if name == "act" else None)
            told[name] = {"inputs": {key: _described(value) for key, value in steps[0].items()}, "runs": measures}
            for run, measure in measures.items():
                log.info("%s: %.1f ms a step, differs by %.1e at most", run, measure["ms"], measure["difference"])
                if not measure["difference"] <= TOLERANCE:  # not a number is none of them
                    raise ValueError(
                        f"{run} differs from the model, by {measure['difference']:.1e} of the range of what comes out: "
                        f"this model cannot be exported{', try export.onnx=false' if 'onnx' in run else ''}"
                    )
        return told


def played(policy: Policy) -> dict[str, list[Inputs]]:
    """What the programs are given in an episode of noise, one step longer than the history: program → inputs."""
    random, draws = np.random.default_rng(0), torch.Generator().manual_seed(0)
    steps: dict[str, list[Inputs]] = {}
    for _ in range(policy.model.history + 1):
        observation = noise(policy.spec, random)
        policy.plan(observation)
        window = policy.window()
        if "tokens" in window:
            steps.setdefault("encode", []).append(_inputs(policy.frame(observation)))
        drawn = policy.model.draw(draws)
        steps.setdefault("act", []).append(_inputs(window if drawn is None else {**window, "noise": drawn}))
    return steps


def capture(program: Encode | Act, inputs: Inputs) -> ExportedProgram:
    """The program as one graph, whatever the length of the sentence."""
    lengths = {program.model.text.tokenize([sentence]).shape[1] for sentence in SENTENCES}
    text = {1: Dim.DYNAMIC} if len(lengths) > 1 else {}
    shapes = {name: text if name == "text" else {} for name in inputs}
    return torch.export.export(program.eval(), (inputs,), dynamic_shapes=(shapes,))


def write_onnx(captured: ExportedProgram, inputs: Inputs, path: Path) -> Run:
    """Write a captured program as ONNX with inputs of the same names; returns what runs it."""
    from onnxruntime import InferenceSession

    made = torch.onnx.export(captured, dynamo=True, verbose=False, input_names=list(inputs), output_names=["output"])
    assert made is not None
    made.save(path)
    session = InferenceSession(path, providers=["CPUExecutionProvider"])
    taken = {node.name for node in session.get_inputs()}  # what a program does not look at is not asked for

    def run(inputs: Inputs) -> Tensor:
        given = {name: value.numpy() for name, value in inputs.items() if name in taken}
        return torch.from_numpy(session.run(None, given)[0])

    return run


def compared(runs: dict[str, Run], steps: list[Inputs], span: Tensor | None) -> dict[str, dict[str, float]]:
    """Largest difference from the first of the runs, relative to `span`, or to the largest number that comes out of it,
    and median time of a step [ms], of each."""
    expected: list[Tensor] = []
    measures = {}
    with torch.inference_mode():
        for name, run in runs.items():
            run(steps[0])  # the first one allocates
            seconds, outputs = [], []
            for inputs in steps:
                started = time.perf_counter()
                outputs.append(run(inputs))
                seconds.append(time.perf_counter() - started)
            expected = expected or outputs
            found, right = torch.stack(outputs), torch.stack(expected)
            apart = ((found - right).abs() / (right.abs().max() if span is None else span)).max()
            measures[name] = {"difference": float(apart), "ms": 1000 * float(np.median(seconds))}
    return measures


def _require_onnx() -> None:
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ValueError("ONNX is not installed: pip install 'vla[onnx]', or export.onnx=false") from error


def _inputs(batch: Batch) -> Inputs:
    return {**batch["rgb"], **{name: value for name, value in batch.items() if name != "rgb"}}


def _batch(model: Model, inputs: Inputs) -> Batch:
    rgb = {camera: inputs[camera] for camera in model.spec.cameras if camera in inputs}
    return {"rgb": rgb, **{name: value for name, value in inputs.items() if name not in rgb}}


def _described(value: Tensor) -> dict[str, Any]:
    return {"dtype": str(value.dtype).removeprefix("torch."), "shape": list(value.shape)}
