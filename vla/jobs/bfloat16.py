"""Warning about bfloat16 on processors without fast instructions for it."""

from __future__ import annotations

import logging
from collections.abc import Container, Mapping
from typing import Any

log = logging.getLogger(__name__)

DEVICE_KEYS = {"trainer": "accelerator", "policy": "device"}  # config group → key of its device


def has_bfloat16() -> bool:
    """Return whether PyTorch has fast kernels for bfloat16 on this processor.

    They need AVX-512, AMX or ARM's bfloat16 instructions. Without them bfloat16 matrix products are about a hundred
    times slower than float32. `ONEDNN_MAX_CPU_ISA` can hide instructions from PyTorch.
    """
    import torch

    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def warn_of_bfloat16(config: Mapping[str, Any], groups: Container[str]) -> None:
    """Log a warning for every one of the config `groups` that selects bfloat16 on a CPU where it is slow."""
    for group, device in DEVICE_KEYS.items():
        node = config[group] if group in groups else None
        if node is None or node.get("precision") != "bf16":
            continue
        if computes_on_cpu(node.get(device)) and not has_bfloat16():
            log.warning(
                "%s.precision=bf16 is slow here: this processor has no instructions for bfloat16 and multiplies "
                "matrices about a hundred times faster in 32 bits, %s.precision=fp32",
                *(group, group),
            )


def computes_on_cpu(device: str | None) -> bool:
    """Return whether `policy.device` or `trainer.accelerator` resolves to the CPU on this machine."""
    import torch

    return device == "cpu" or not torch.cuda.is_available()
