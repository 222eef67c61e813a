"""What this machine lacks: fast instructions for bfloat16, or the compiler that PyTorch needs to compile a model."""

from __future__ import annotations

import logging
import os
import shlex
import shutil
from collections.abc import Container, Mapping
from typing import Any

from vla.io.errors import UserError

log = logging.getLogger(__name__)

DEVICES = {"trainer": "accelerator", "policy": "device"}  # group → key of its device


def has_bfloat16() -> bool:
    """Return whether PyTorch has fast kernels for bfloat16 on this processor.

    They need AVX-512, AMX or ARM's bfloat16 instructions. Without them bfloat16 matrix products are about a hundred
    times slower than float32. `ONEDNN_MAX_CPU_ISA` can hide instructions from PyTorch.
    """
    import torch

    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def warn_of_bfloat16(config: Mapping[str, Any], groups: Container[str]) -> None:
    """Log a warning for every one of the config `groups` that selects bfloat16 on a CPU where it is slow."""
    for group, device in DEVICES.items():
        node = (config[group] if group in groups else None) or {}
        if node.get("precision") == "bf16" and computes_on_cpu(node.get(device)) and not has_bfloat16():
            log.warning(
                "%s.precision=bf16 is slow here: this processor has no instructions for bfloat16 and multiplies "
                "matrices about a hundred times faster in 32 bits, %s.precision=fp32",
                *(group, group),
            )


def computes_on_cpu(device: str | None) -> bool:
    """Return whether `policy.device` or `trainer.accelerator` resolves to the CPU on this machine."""
    import torch

    return device == "cpu" or not torch.cuda.is_available()


def require_compiler(config: Mapping[str, Any], groups: Container[str]) -> None:
    """Raise a UserError if a job that builds `groups` compiles a model, and this machine has no compiler.

    On a CPU PyTorch calls a C++ compiler, on a GPU Triton calls a C compiler, which the packages of the former include.
    """
    compilers = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++"]
    for name in ("learner", "policy"):
        compiles = name in groups and (config[name] or {}).get("compile") is True
        if compiles and not any(map(_is_installed, compilers)):
            raise UserError(
                f"{name}.compile needs a C++ compiler, and there is no {' or '.join(compilers)}: install g++ and "
                f"python3-dev, or set {name}.compile=false"
            )


def _is_installed(command: str) -> bool:
    """Return whether the program of a shell command exists; False for none, and for an unbalanced quotation mark."""
    try:
        words = shlex.split(command)
    except ValueError:
        return False
    return bool(words) and shutil.which(words[0]) is not None
