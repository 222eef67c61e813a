"""What this machine lacks: fast instructions for bfloat16, or the compiler that PyTorch needs to compile a model."""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import sys
import sysconfig
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from vla.io.errors import UserError

log = logging.getLogger(__name__)

COMPILING = {"learner": "trainer", "policy": "policy"}  # group with a key `compile` → group of its device
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
    """Raise a UserError if a job that builds `groups` compiles a model, and this machine lacks compiler or headers.

    On a CPU PyTorch calls a C++ compiler, on a GPU Triton calls one of C, and both include the headers of Python.
    """
    compiling = [
        (name, "false") for name in COMPILING if name in groups and (config[name] or {}).get("compile") is True
    ]
    if "benchmark" in groups and "train" in config["benchmark"]["names"] and any(config["benchmark"]["compile"]):
        compiling.append(("benchmark", "[false]"))
    for name, off in compiling:
        group = COMPILING.get(name, "trainer")
        if missing := _missing(computes_on_cpu(config[group].get(DEVICES[group]))):
            raise UserError(f"{name}.compile needs {missing}, or set {name}.compile={off}")


def _missing(on_processor: bool) -> str:
    """Return what this machine lacks to compile, and how to get it; nothing if it can."""
    if on_processor:
        known = [os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")]
        language, package = "C++", "g++"
    else:
        known = [os.environ["CC"]] if "CC" in os.environ else ["gcc", "clang"]
        language, package = "C", "gcc"
    if not any(shutil.which(shlex.split(each)[0]) for each in known if each.strip()):
        return f"a {language} compiler, and there is no {' or '.join(known)}: install {package}"
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        return f"the header files of Python in {sysconfig.get_path('include')}: install python3-dev"
    return ""
