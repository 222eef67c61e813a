"""The compiler of the machine, which PyTorch needs to compile a model."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import sysconfig
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from vla.jobs.bfloat16 import computes_on_cpu

# Node with a key `compile` → key of the device for which it compiles.
COMPILING = {"learner": "trainer.accelerator", "policy": "policy.device", "benchmark": "trainer.accelerator"}


def require_compiler(config: Mapping[str, Any], groups: Container[str]) -> None:
    """Refuse a config of which a job that builds `groups` compiles a model, where this machine cannot.

    On a CPU PyTorch calls a C++ compiler, on a GPU Triton calls one of C, and both include the headers of Python.

    Raises:
        ValueError: the compiler or the headers are missing.
    """
    for name, device in COMPILING.items():
        if _compiles(config, name, groups):
            group, _, key = device.partition(".")
            if missing := _missing(computes_on_cpu(config[group].get(key))):
                off = "[false]" if name == "benchmark" else "false"
                raise ValueError(f"{name}.compile needs {missing}, or set {name}.compile={off}")


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
