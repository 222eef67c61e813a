"""Which arithmetic the processor of this machine is made for."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from vla.check import JOBS

log = logging.getLogger(__name__)

# Group → the key that names its device, and its precision of 32 bits.
COMPUTING = {"trainer": ("accelerator", "32-true"), "policy": ("device", "32")}


def has_bfloat16() -> bool:
    """Whether PyTorch has fast kernels for bfloat16 on this processor.

    They need AVX-512, AMX or ARM's bfloat16 instructions. Without them PyTorch multiplies bfloat16 matrices about a
    hundred times slower than those of 32 bits. `ONEDNN_MAX_CPU_ISA` can hide instructions from PyTorch.
    """
    import torch

    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def warn_of_bfloat16(config: Mapping[str, Any]) -> None:
    """Log a warning for everything in a job's configuration that makes a processor compute in bfloat16 slowly."""
    for group, (device, full) in COMPUTING.items():
        node = config[group] if group in JOBS[config["job"]] else None
        if node is None or not str(node.get("precision")).startswith("bf16"):
            continue
        if computes_on_processor(node.get(device)) and not has_bfloat16():
            log.warning(
                "%s.precision=%s is slow here: this processor has no instructions for bfloat16 and multiplies matrices "
                "about a hundred times faster in 32 bits, %s.precision=%s",
                *(group, node["precision"], group, full),
            )


def computes_on_processor(device: str | None) -> bool:
    """Whether a device, as `policy.device` and `trainer.accelerator` name it, is the processor here."""
    import torch

    return device == "cpu" or not torch.cuda.is_available()
