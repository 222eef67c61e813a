"""How much arithmetic a training step takes, and how much a device can do.

The model FLOPs utilisation of a training is `training_flops` times batches per second, over the peak of its device:
`peak_flops` of its data sheet, else the best rate that was measured, by `matmul_flops` or in the training itself.
"""

from __future__ import annotations

import copy
import re
import time
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, conv_flop_count

from vla.models.model import Batch, Model

WINDOWS = 2  # to count on: batch normalisation wants more than one value
SIZES = (128, 256, 512, 1024, 2048, 4096, 8192)  # of matrices whose products are timed

# Rates of dense matrix multiplication [FLOP/s], bfloat16 or float16, TensorFloat-32, float32 without tensor cores, from
# NVIDIA's data sheets of H100, H200, A100 and L40S, which print twice these rates for tensor cores where they assume
# sparsity. The first whose words are all in the device's name counts.
PEAKS = (
    ("H100 PCIe", 756e12, 378e12, 51e12),
    ("H100 NVL", 835e12, 417e12, 60e12),
    ("H100", 989e12, 494e12, 67e12),  # SXM, which calls itself H100 80GB HBM3
    ("H200 NVL", 835e12, 417e12, 60e12),
    ("H200", 989e12, 494e12, 67e12),
    ("A100", 312e12, 156e12, 19.5e12),
    ("L40S", 362e12, 183e12, 91.6e12),
)


def training_flops(model: Model, batch: Batch) -> float:
    """FLOPs of forward and backward over a batch that has its "text": one multiply-add is two.

    Counted are matrix products, convolutions and attention. Left out is what is not made of them: elementwise
    functions, normalisation, softmax, pooling, the shifting of images, sums of gradients, the optimiser's step. A copy
    of the model computes a few windows of the batch in 32 bits, so that neither its weights and statistics nor the
    random numbers of the training change.
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
    """FLOPs of the gradients, given shapes: each of them takes as many as the convolution itself.

    torch counts the weights' as if every channel met every other one, also where they are in groups.
    """
    return conv_flop_count(images, weight, gradient, transposed) * sum(wanted[:2])


def _first(batch: Any, count: int) -> Any:
    """The first so many windows of a batch, whose values are tensors and lists, in dicts."""
    return {name: _first(value, count) for name, value in batch.items()} if isinstance(batch, dict) else batch[:count]


def peak_flops(device: torch.device, precision: str) -> float | None:
    """What a device can do at most [FLOP/s] in a precision of Lightning's trainer, such as "bf16-mixed".

    In 32 bits it depends on `torch.get_float32_matmul_precision()`. None for what no data sheet is known of: a CPU,
    another GPU, a slice of one, another precision; `matmul_flops` measures a rate to compare with.
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


def matmul_flops(device: torch.device, precision: str, seconds: float = 1.0) -> float:
    """The best rate [FLOP/s] of square matrix products of several sizes on a device, measured for about some seconds.

    It stands in for the peak where no data sheet gives one. Mixed precisions compute in 32 bits as well, so their rate
    is the better one of both. Sizes whose single product would take longer than all others together are left out.
    """
    short = {"bf16": torch.bfloat16, "16": torch.float16, "64": torch.float64}
    kinds = {short.get(precision.partition("-")[0], torch.float32)}
    kinds |= {torch.float32} if precision.endswith("mixed") else set()
    return max(_best_rate(device, kind, seconds / len(kinds)) for kind in kinds)


def _best_rate(device: torch.device, kind: torch.dtype, seconds: float) -> float:
    best = 0.0
    for size in SIZES:
        flops = 2 * size**3
        if best and flops / best > seconds:
            break
        matrix = torch.randn(size, size, device=device).to(kind)
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
