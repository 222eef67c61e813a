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

# Node with a key `compile` → key of the device for which it compiles.
COMPILING = {"learner": "trainer.accelerator", "policy": "policy.device", "benchmark": "trainer.accelerator"}
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


def require_compiler(config: Mapping[str, Any], groups: Container[str]) -> None:
    """Refuse a config of which a job that builds `groups` compiles a model, where this machine cannot.

    On a CPU PyTorch calls a C++ compiler, on a GPU Triton calls one of C, and both include the headers of Python.

    Raises:
        UserError: the compiler or the headers are missing.
    """
    for name, device in COMPILING.items():
        if _compiles(config, name, groups):
            group, _, key = device.partition(".")
            if missing := _missing(computes_on_cpu(config[group].get(key))):
                off = "[false]" if name == "benchmark" else "false"
                raise UserError(f"{name}.compile needs {missing}, or set {name}.compile={off}")


def _compiles(config: Mapping[str, Any], name: str, groups: Container[str]) -> bool:
    node = config.get(name) or {}
    if name == "benchmark":
        return config["job"] == name and "train" in node["names"] and any(node["compile"])
    return name in groups and node.get("compile") is True


def _missing(on_processor: bool) -> str:
    """Return what this machine lacks to compile, and how to get it; nothing if it can."""
    on_mac = sys.platform == "darwin"
    if on_processor:
        known = [os.environ.get("CXX", "clang++" if on_mac else "g++")]
        language, package = "C++", "g++"
    else:
        known = [os.environ["CC"]] if "CC" in os.environ else ["gcc", "clang"]
        language, package = "C", "gcc"
    if not any(shutil.which(shlex.split(each)[0]) for each in known if each.strip()):
        return f"a {language} compiler, and there is no {' or '.join(known)}: install {package}"
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        return f"the header files of Python in {sysconfig.get_path('include')}: install python3-dev"
    return ""
