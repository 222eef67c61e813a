"""The ONNX programs of a trained policy, to run without this project, or in place of the model."""

# T frames of history, N tokens per frame, E width of a token, L tokens of an instruction, k action chunk, D components

from __future__ import annotations

import hashlib
import inspect
import logging
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnxruntime
import onnxscript  # noqa: F401  # needed by `torch.onnx.export`
import torch
from filelock import FileLock
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from vla.io.documents import lines_of
from vla.io.errors import UserError
from vla.io.files import atomic_path, write_json
from vla.io.types import Text
from vla.models.decoder import Decoder
from vla.models.model import Batch, Model, Prediction
from vla.policy import Policy
from vla.spec import Spec

log = logging.getLogger(__name__)

Inputs = dict[str, Tensor]
Run = Callable[[Inputs], Tensor]

TOLERANCE = 1e-3  # largest difference between the outputs of a program and of the model, relative to their range
INSTRUCTIONS = ("go", "do this first, and then something else " * 5)  # of different lengths


class Program(nn.Module):
    """A part of a model, as it is exported: named inputs → one output.

    - encode: one frame → its cached tokens (1, 1, N, E), of a model that caches the tokens of past frames. Inputs are
      each camera's (1, 1, H, W, 3) uint8, state (1, 1, P), present (1, 1) bool, text (1, L).
    - act: a window of frames → the actions after its newest one, (1, k, D), not clipped to the bounds of the spec.
      Inputs are tokens (1, T, N, E), or T frames of the inputs of encode; present (1, T), text (1, L); for a model that
      samples its actions also noise (1, k, D), standard normal.
    """

    def __init__(self, model: Model, part: Literal["encode", "act"]) -> None:
        super().__init__()
        self.model, self.part = model, part

    def forward(self, inputs: Inputs) -> Tensor:
        """Return the output."""
        rgb = {camera: inputs[camera] for camera in self.model.spec.cameras if camera in inputs}
        batch: Batch = {"rgb": rgb, **{name: value for name, value in inputs.items() if name not in rgb}}
        output = self.model.predict(batch).actions if self.part == "act" else self.model.encode(batch)
        assert output is not None
        return output


class OnnxPolicy(Policy):
    """A policy on the CPU that encodes frames and predicts actions with the ONNX programs of its model.

    The programs are exported once and kept in `folder`, below a digest of code, options and weights of the model:
    `act.onnx`, `encode.onnx` if the model caches tokens of past frames, and `program.json` with their inputs. They
    differ from the model by at most a thousandth of the range of an action, on an episode of noise, return no
    probabilities, and take one observation at a time. Raises a UserError if the model cannot be exported.
    """

    @staticmethod
    def require_exportable(model: type, tokenizer: type) -> None:
        """Raise a UserError if models of a class decode sequences of varying length with a class of tokenizers."""
        if issubclass(model, Decoder) and getattr(tokenizer, "end", -1) >= 0:
            names = f"{model.__name__} with {tokenizer.__name__}"
            raise UserError(f"{names} cannot be exported, as its sequences vary in length: use policy=default")

    def __init__(self, folder: Text | Path, *, model: Model, spec: Spec) -> None:
        super().__init__("cpu", "fp32", compile=False, lanes=1, model=model, spec=spec)
        programs = Path(folder).resolve() / digest(model, spec)
        programs.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{programs}.lock"):  # several processes build the policy of an evaluation at once
            if not programs.exists():
                log.info("exporting the model to %s", programs)
                write_programs(self, programs)
        act = open_onnx(programs / "act.onnx")
        self._predict_chunk = lambda batch: Prediction(act(inputs_of(batch)))
        if (encoder := programs / "encode.onnx").exists():  # the model caches tokens of past frames
            encode = open_onnx(encoder)
            self._encode = lambda batch: encode(inputs_of(batch))


def write_programs(policy: Policy, folder: Path) -> None:
    """Write the programs of a policy, on the CPU and not compiled, and `program.json` into a new folder, atomically.
    Raises a UserError if the output of a program differs from the model's."""
    span = torch.tensor(np.subtract(policy.spec.high, policy.spec.low), dtype=torch.float32)
    report: dict[str, Any] = {"model": type(policy.model).__name__, "spec": policy.spec.to_dict()}
    with atomic_path(folder) as draft:
        draft.mkdir(parents=True)
        for part, steps in example_inputs(policy).items():
            program, path = Program(policy.model, part), draft / f"{part}.onnx"
            graph, names = capture(program, steps[0]), list(steps[0])
            export = torch.onnx.export(graph, dynamo=True, verbose=False, input_names=names, output_names=["output"])
            assert export is not None
            export.save(path)
            difference = _difference(program, open_onnx(path), steps, span if part == "act" else None)
            log.info("%s: largest difference %.1e", path.name, difference)
            if not difference <= TOLERANCE:  # also for NaN
                raise UserError(
                    f"{path.name} differs from the model by {difference:.1e} of the output range: this model cannot "
                    "be exported"
                )
            inputs = {
                name: {"dtype": str(value.dtype).removeprefix("torch."), "shape": list(value.shape)}
                for name, value in steps[0].items()
            }
            report[part] = {"inputs": inputs, "difference": difference}
        write_json(draft / "program.json", report)


def example_inputs(policy: Policy) -> dict[Literal["encode", "act"], list[Inputs]]:
    """Return part → inputs of every step, for an episode of noise that is one step longer than the history."""
    random, draws = np.random.default_rng(0), torch.Generator().manual_seed(0)
    frames, windows = list[Inputs](), list[Inputs]()
    for _ in range(policy.model.history + 1):
        observation = policy.spec.random_observation(random)
        policy.plan(observation)
        window, noise = policy.window(), policy.model.sample_noise(draws)
        if "tokens" in window:
            frames.append(inputs_of(policy.frame(observation)))
        windows.append(inputs_of(window if noise is None else {**window, "noise": noise}))
    return {"encode": frames, "act": windows} if frames else {"act": windows}


def inputs_of(batch: Batch) -> Inputs:
    """Return the inputs of a program in a batch."""
    return {**batch["rgb"], **{name: value for name, value in batch.items() if name != "rgb"}}


def capture(program: Program, inputs: Inputs) -> ExportedProgram:
    """Trace a program as one graph for instructions of any length; raise a UserError if that fails."""
    model = program.model
    lengths = {model.text.tokenize([instruction]).shape[1] for instruction in INSTRUCTIONS}
    text = {1: Dim.DYNAMIC} if len(lengths) > 1 else {}
    shapes = {name: text if name == "text" else {} for name in inputs}
    try:
        return torch.export.export(program.eval(), (inputs,), dynamic_shapes=(shapes,))
    except Exception as error:  # of many kinds
        names = f"{type(model).__name__} with {type(model.tokenizer).__name__}"
        raise UserError(f"{names} cannot be exported: {lines_of(error)[0]}") from error


def open_onnx(path: Path) -> Run:
    """Return a function that runs an ONNX program on the CPU; raise a UserError if the file is damaged."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    # Else the idle threads of one program wait in a busy loop, and slow down the program that runs next.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of its own kinds
        raise UserError(f"{path} is damaged: delete its folder, and the policy is exported again") from error
    names = {node.name for node in session.get_inputs()}  # without inputs that the program ignores

    def run(inputs: Inputs) -> Tensor:
        arrays = {name: value.numpy() for name, value in inputs.items() if name in names}
        return torch.from_numpy(session.run(None, arrays)[0])

    return run


def _difference(program: Run, exported: Run, steps: list[Inputs], span: Tensor | None) -> float:
    """Return the largest difference between two outputs, relative to `span` or else to the largest output."""
    with torch.inference_mode():
        reference, output = (torch.stack([run(inputs) for inputs in steps]) for run in (program, exported))
        return float(((output - reference).abs() / (reference.abs().max() if span is None else span)).max())


def digest(model: Model, spec: Spec) -> str:
    """Return a digest of versions, code, options and weights, sixteen hexadecimal digits."""
    content = hashlib.sha256(f"{torch.__version__} {onnxruntime.__version__} {spec.to_dict()}".encode())
    kinds = {kind for module in model.modules() for kind in type(module).__mro__ if issubclass(kind, nn.Module)}
    for file in sorted({inspect.getfile(kind) for kind in kinds}):
        content.update(Path(file).read_bytes())
    for name, module in model.named_modules():
        plain_types = (bool, int, float, str, tuple)
        options = {key: value for key, value in vars(module).items() if isinstance(value, plain_types)}
        content.update(repr((name, type(module).__qualname__, options)).encode())
    for values in chain(model.parameters(), model.buffers()):
        content.update(values.detach().contiguous().numpy().tobytes())
    return content.hexdigest()[:16]
