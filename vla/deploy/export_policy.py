"""Export of a trained policy as programs that run without this project: torch.export and ONNX."""

# T frames of history, N tokens per frame, E width of a token, L tokens of an instruction, k action chunk, D components

from __future__ import annotations

import io
import json
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram
from torch.onnx import ONNXProgram

from vla.io.documents import lines_of
from vla.io.errors import UserError
from vla.io.files import atomic_path
from vla.io.types import Text
from vla.models.layers import Batch
from vla.models.model import Model
from vla.policy import Policy

log = logging.getLogger(__name__)

Inputs = dict[str, Tensor]
Run = Callable[[Inputs], Tensor]
Write = Callable[[ExportedProgram, Inputs, Path], Run]

TOLERANCE = 1e-3  # largest difference between the outputs of a program and of the model, relative to their range
INSTRUCTIONS = ("go", "do this first, and then something else")  # of different lengths


class Program(nn.Module):
    """A part of a model, as it is exported."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model


class Encode(Program):
    """One frame → its cached tokens (1, 1, N, E), of a model that caches the tokens of past frames."""

    def forward(self, inputs: Inputs) -> Tensor:
        """Named inputs: each camera's (1, 1, H, W, 3) uint8, state (1, 1, P), present (1, 1) bool, text (1, L)."""
        tokens = self.model.encode(_batch(self.model, inputs))
        assert tokens is not None
        return tokens


class Act(Program):
    """A window of frames → the actions after its newest one: (1, k, D), not clipped to the bounds of the spec."""

    def forward(self, inputs: Inputs) -> Tensor:
        """Named inputs: tokens (1, T, N, E), or T frames of the inputs of `Encode`; present (1, T), text (1, L);
        for a model that samples its actions also noise (1, k, D), standard normal."""
        return self.model.predict(_batch(self.model, inputs)).actions


class ProgramExporter:
    """Writes a trained policy as `act.pt2` and `act.onnx`, and as `encode.…` if the model caches tokens of past frames.

    Each program is then compared with the model on an episode of noise; `program.json` lists the inputs, the largest
    difference and the time per step. The folder is written atomically.

    Args:
        folder: output folder, which must not exist.
        onnx: write ONNX too, which needs the extra `onnx`.
    """

    def __init__(self, folder: Text | Path, onnx: bool) -> None:
        self._folder, self._onnx = Path(folder).resolve(), onnx

    def export_policy(self, policy: Policy) -> Path:
        """Write the programs of a policy, in float32 for the CPU whatever its device is; returns the folder.

        Raises:
            UserError: the folder exists, ONNX is not installed, or the output of a program differs from the model's.
        """
        if self._folder.exists():
            raise UserError(f"{self._folder} exists already: choose another export.folder")
        if self._onnx:
            require_onnx("export.onnx=false")
        policy = Policy("cpu", "fp32", compile=False, lanes=1, model=policy.model, spec=policy.spec)
        write_programs(policy, self._folder, {"pt2": write_pt2, **({"onnx": write_onnx} if self._onnx else {})})
        return self._folder


def write_programs(policy: Policy, folder: Path, formats: Mapping[str, Write], tolerance: float = TOLERANCE) -> None:
    """Write the programs of a policy and `program.json` into a new folder, atomically.

    Args:
        policy: on the CPU, in float32 and not compiled.
        folder: must not exist.
        formats: suffix of a program → function that writes it.
        tolerance: largest difference between the outputs of a program and of the model, relative to their range.

    Raises:
        UserError: the output of a program differs from the model's.
    """
    model, span = policy.model, torch.tensor(np.subtract(policy.spec.high, policy.spec.low), dtype=torch.float32)
    report: dict[str, Any] = {"model": type(model).__name__, "spec": policy.spec.to_dict()}
    with atomic_path(folder) as draft:
        draft.mkdir(parents=True)
        for name, steps in example_inputs(policy).items():
            program = (Act if name == "act" else Encode)(model)
            captured = capture(program, steps[0])
            runs: dict[str, Run] = {"model": program}
            for suffix, write in formats.items():
                runs[f"{name}.{suffix}"] = write(captured, steps[0], draft / f"{name}.{suffix}")
            measures = compare(runs, steps, span if name == "act" else None)
            report[name] = {"inputs": {key: _describe(value) for key, value in steps[0].items()}, "runs": measures}
            for run, measure in measures.items():
                log.info("%s: %.1f ms per step, largest difference %.1e", run, measure["ms"], measure["difference"])
                if not measure["difference"] <= tolerance:  # also true for NaN
                    raise UserError(
                        f"{run} differs from the model by {measure['difference']:.1e} of the output range: "
                        f"this model cannot be exported{', try export.onnx=false' if 'onnx' in run else ''}"
                    )
        (draft / "program.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def example_inputs(policy: Policy) -> dict[str, list[Inputs]]:
    """Return program → inputs of every step, for an episode of noise that is one step longer than the history."""
    random, draws = np.random.default_rng(0), torch.Generator().manual_seed(0)
    steps: dict[str, list[Inputs]] = {}
    for _ in range(policy.model.history + 1):
        observation = policy.spec.random_observation(random)
        policy.plan(observation)
        window = policy.window()
        if "tokens" in window:
            steps.setdefault("encode", []).append(inputs_of(policy.frame(observation)))
        noise = policy.model.sample_noise(draws)
        steps.setdefault("act", []).append(inputs_of(window if noise is None else {**window, "noise": noise}))
    return steps


def capture(program: Encode | Act, inputs: Inputs) -> ExportedProgram:
    """Trace the program as one graph for instructions of any length.

    Raises:
        UserError: it computes outside PyTorch, as `tokenizer=fast` does.
    """
    model = program.model
    lengths = {model.text.tokenize([instruction]).shape[1] for instruction in INSTRUCTIONS}
    text = {1: Dim.DYNAMIC} if len(lengths) > 1 else {}
    shapes = {name: text if name == "text" else {} for name in inputs}
    try:
        return torch.export.export(program.eval(), (inputs,), dynamic_shapes=(shapes,))
    except Exception as error:  # of many kinds
        names = f"{type(model).__name__} with {type(model.tokenizer).__name__}"
        raise UserError(f"{names} cannot be exported: {lines_of(error)[0]}") from error


def write_pt2(captured: ExportedProgram, inputs: Inputs, path: Path) -> Run:
    """Write a captured program in PyTorch's format; returns a function that runs it."""
    archive = io.BytesIO()
    torch.export.save(captured, archive)
    path.write_bytes(archive.getbuffer())  # torch's own writing hides errors of the disk
    return torch.export.load(path).module()


def write_onnx(captured: ExportedProgram, inputs: Inputs, path: Path) -> Run:
    """Write a captured program as ONNX with inputs of the same names; returns a function that runs it."""
    _as_onnx(captured, inputs).save(path)
    return open_onnx(path)


def write_quantized(captured: ExportedProgram, inputs: Inputs, path: Path) -> Run:
    """Write a captured program as ONNX with matrix products of 8-bit integers; returns a function that runs it."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    exact = _as_onnx(captured, inputs).model_proto
    del exact.graph.value_info[:]  # shapes of weights, which quantisation transposes
    quantize_dynamic(exact, path, weight_type=QuantType.QUInt8, op_types_to_quantize=["MatMul", "Gemm"])
    return open_onnx(path)


def _as_onnx(captured: ExportedProgram, inputs: Inputs) -> ONNXProgram:
    onnx = torch.onnx.export(captured, dynamo=True, verbose=False, input_names=list(inputs), output_names=["output"])
    assert onnx is not None
    return onnx


def open_onnx(path: Path, threads: int | None = None) -> Run:
    """Return a function that runs an ONNX program on the CPU, by default with as many threads as PyTorch.

    Raises:
        UserError: the file is damaged.
    """
    from onnxruntime import InferenceSession, SessionOptions

    options = SessionOptions()
    options.intra_op_num_threads = threads or torch.get_num_threads()
    # Else the idle threads of one program wait in a busy loop, and slow down the program that runs next.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    try:
        session = InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of its own kinds
        raise UserError(f"{path} is damaged: delete its folder, and export the policy again") from error
    used = {node.name for node in session.get_inputs()}  # without inputs that the program ignores

    def run(inputs: Inputs) -> Tensor:
        given = {name: value.numpy() for name, value in inputs.items() if name in used}
        return torch.from_numpy(session.run(None, given)[0])

    return run


def compare(runs: dict[str, Run], steps: list[Inputs], span: Tensor | None) -> dict[str, dict[str, float]]:
    """Compare the outputs of every run with those of the first one.

    Returns the largest difference, relative to `span` or else to the largest output, and the median time per step [ms].
    """
    expected: list[Tensor] = []
    measures = {}
    with torch.inference_mode():
        for name, run in runs.items():
            run(steps[0])  # the first run allocates memory
            seconds, outputs = [], []
            for inputs in steps:
                started = time.perf_counter()
                outputs.append(run(inputs))
                seconds.append(time.perf_counter() - started)
            expected = expected or outputs
            actual, reference = torch.stack(outputs), torch.stack(expected)
            difference = ((actual - reference).abs() / (reference.abs().max() if span is None else span)).max()
            measures[name] = {"difference": float(difference), "ms": 1000 * float(np.median(seconds))}
    return measures


def require_onnx(otherwise: str) -> None:
    """Raise a UserError that names what to do `otherwise`, unless ONNX is installed."""
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise UserError(f"ONNX is not installed: pip install 'vla[onnx]', or {otherwise}") from error


def inputs_of(batch: Batch) -> Inputs:
    return {**batch["rgb"], **{name: value for name, value in batch.items() if name != "rgb"}}


def _batch(model: Model, inputs: Inputs) -> Batch:
    rgb = {camera: inputs[camera] for camera in model.spec.cameras if camera in inputs}
    return {"rgb": rgb, **{name: value for name, value in inputs.items() if name not in rgb}}


def _describe(value: Tensor) -> dict[str, Any]:
    return {"dtype": str(value.dtype).removeprefix("torch."), "shape": list(value.shape)}
