"""A policy whose model runs as ONNX programs."""

from __future__ import annotations

import hashlib
import inspect
import logging
import math
from itertools import chain
from pathlib import Path

import torch
from filelock import FileLock
from torch import nn

from vla.deploy.export_policy import (
    TOLERANCE,
    inputs_of,
    open_onnx,
    require_onnx,
    write_onnx,
    write_programs,
    write_quantized,
)
from vla.io.types import Count, Text
from vla.models.model import Model, Prediction
from vla.policy import Policy
from vla.spec import Spec

log = logging.getLogger(__name__)


class OnnxPolicy(Policy):
    """A policy on the CPU that encodes frames and predicts actions with the ONNX programs of its model.

    The programs are exported once and kept, in a folder named by a digest of code, options and weights of the model.
    Exact ones differ from the model by at most a thousandth of the range of an action, on an episode of noise. They
    return no probabilities, and take one observation at a time.

    Args:
        threads: of a program; null: as many as PyTorch uses.
        quantize: matrix products of 8-bit integers, which differ further from the model.
        folder: of all exported programs.

    Raises:
        UserError: ONNX is not installed, or the model cannot be exported.
    """

    def __init__(self, threads: Count | None, quantize: bool, folder: Text | Path, *, model: Model, spec: Spec) -> None:
        require_onnx("policy=default")
        super().__init__("cpu", "fp32", compile=False, lanes=1, model=model, spec=spec)
        suffix = "int8.onnx" if quantize else "onnx"
        programs = Path(folder).resolve() / f"{digest(model, spec)}{'_int8' if quantize else ''}"
        programs.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{programs}.lock"):  # several processes build the policy of an evaluation at once
            if not programs.exists():
                log.info("exporting the model to %s", programs)
                write = {suffix: write_quantized if quantize else write_onnx}
                write_programs(self, programs, write, math.inf if quantize else TOLERANCE)
        act = open_onnx(programs / f"act.{suffix}", threads)
        self._predict_chunk = lambda batch: Prediction(act(inputs_of(batch)))
        if (encoder := programs / f"encode.{suffix}").exists():  # the model caches tokens of past frames
            encode = open_onnx(encoder, threads)
            self._encode = lambda batch: encode(inputs_of(batch))


def digest(model: Model, spec: Spec) -> str:
    """Return a digest of versions, code, options and weights, sixteen hexadecimal digits."""
    import onnxruntime

    content = hashlib.sha256(f"{torch.__version__} {onnxruntime.__version__} {spec.to_dict()}".encode())
    modules = dict(model.named_modules())
    kinds = {kind for module in modules.values() for kind in type(module).__mro__ if issubclass(kind, nn.Module)}
    for file in sorted({inspect.getfile(kind) for kind in kinds}):
        content.update(Path(file).read_bytes())
    for name, module in modules.items():
        options = {
            key: value for key, value in vars(module).items() if isinstance(value, bool | int | float | str | tuple)
        }
        content.update(repr((name, type(module).__qualname__, options)).encode())
    for values in chain(model.parameters(), model.buffers()):
        content.update(values.detach().contiguous().numpy().tobytes())
    return content.hexdigest()[:16]
