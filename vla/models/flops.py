"""FLOPs of a training step and peak FLOP/s of a device.

The model FLOPs utilisation of a training is `training_flops` times batches per second, over the peak of its device:
`peak_flops` from its data sheet, or else the best measured rate, of `matmul_flops` or of the training itself.
"""

from __future__ import annotations

import copy
import re
import time
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, conv_flop_count

from vla.models.layers import Batch
from vla.models.model import Model

WINDOWS = 2  # counted; batch normalisation needs more than one value
SIZES = (128, 256, 512, 1024, 2048, 4096, 8192)  # of matrices whose products are timed

# Rates of dense matrix multiplication [FLOP/s], bfloat16 or float16, TensorFloat-32, float32 without tensor cores, from
# NVIDIA's data sheets of H100, H200, A100 and L40S, which print twice these rates for tensor cores where they assume
# sparsity. The first entry whose words are all in the device's name applies. Lightning's `get_available_flops` lacks
# the H200, and confuses L40S with L4, RTX A1000 with A100, and a MIG slice with a whole GPU.
PEAKS = (
    ("H100 PCIe", 756e12, 378e12, 51e12),
    ("H100 NVL", 835e12, 417e12, 60e12),
    ("H100", 989e12, 494e12, 67e12),  # SXM, named H100 80GB HBM3
    ("H200 NVL", 835e12, 417e12, 60e12),
    ("H200", 989e12, 494e12, 67e12),
    ("A100", 312e12, 156e12, 19.5e12),
    ("L40S", 362e12, 183e12, 91.6e12),
)


def training_flops(model: Model, batch: Batch) -> float:
    """Count the FLOPs of forward and backward over a batch with "text"; one multiply-add is two.

    Matrix products, convolutions and attention are counted; elementwise functions, normalisation, softmax, pooling,
    image shifts, gradient accumulation and the optimiser step are not. A copy of the model computes a few windows of
    the batch in 32 bits, so that weights, statistics and random state of the training do not change.
    """
    windows = min(len(batch["action"]), WINDOWS)
    trial = copy.deepcopy(model).float().train()
    device = batch["action"].device
    counter = FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten.convolution_backward: _convolution_backward}
    )
    with torch.random.fork_rng([device] if device.type == "cuda" else []), counter:
        trial.loss(_first(batch, windows))["loss"].backward()
    return counter.get_total_flops() * len(batch["action"]) / windows


def _convolution_backward(
    gradient: list[int],
    images: list[int],
    weight: list[int],
    bias: Any,
    stride: Any,
    padding: Any,
    dilation: Any,
    transposed: bool,
    output_padding: Any,
    groups: int,
    wanted: list[bool],
    **_: Any,
) -> int:
    """Count the FLOPs of the gradients, given shapes: each takes as many as the convolution itself.

    torch ignores `groups` in the weight gradient.
    """
    return conv_flop_count(images, weight, gradient, transposed) * sum(wanted[:2])


def _first(batch: Any, count: int) -> Any:
    """Return the first `count` windows of a batch of nested dicts with tensors and lists."""
    return {name: _first(value, count) for name, value in batch.items()} if isinstance(batch, dict) else batch[:count]


def peak_flops(device: torch.device, precision: str) -> float | None:
    """Return the peak rate of a device [FLOP/s] in a precision of Lightning's trainer, such as "bf16-mixed".

    In 32 bits it depends on `torch.get_float32_matmul_precision()`. None for a CPU, an unlisted GPU, a MIG slice or
    another precision; `matmul_flops` measures a rate instead.
    """
    words = set(re.split("[ -]", torch.cuda.get_device_name(device))) if device.type == "cuda" else set()
    if "MIG" in words:
        return None
    for name, half, tensor_float, full in PEAKS:
        if words.issuperset(name.split()):
            if precision.startswith(("bf16", "16")):
                return half
            if precision.startswith("32"):
                return full if torch.get_float32_matmul_precision() == "highest" else tensor_float
    return None


def matmul_flops(device: torch.device, precision: str, seconds: float) -> float:
    """Measure the best rate [FLOP/s] of square matrix products of several sizes on a device, for about `seconds`.

    It replaces the peak of a data sheet. Mixed precisions also compute in 32 bits, so their rate is the better of both.
    Sizes whose single product would exceed the time are skipped.
    """
    short = {"bf16": torch.bfloat16, "16": torch.float16, "64": torch.float64}
    dtypes = {short.get(precision.partition("-")[0], torch.float32)}
    dtypes |= {torch.float32} if precision.endswith("mixed") else set()
    return max(_best_rate(device, dtype, seconds / len(dtypes)) for dtype in dtypes)


def _best_rate(device: torch.device, dtype: torch.dtype, seconds: float) -> float:
    best = 0.0
    for size in SIZES:
        flops = 2 * size**3
        if best and flops / best > seconds:
            break
        matrix = torch.randn(size, size, device=device).to(dtype)
        end = time.perf_counter() + seconds / len(SIZES)
        while True:
            started = time.perf_counter()
            matrix @ matrix
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            ended = time.perf_counter()
            best = max(best, flops / (ended - started))
            if ended > end:
                break
    return best
