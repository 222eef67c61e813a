"""PyTorch's cache of compiled graphs, one per instruction set."""

from __future__ import annotations

import os
from zlib import crc32

import torch

CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"


def set_compile_cache() -> None:
    """Set PyTorch's cache folder of compiled graphs to one per instruction set, unless the user has set it.

    A graph compiled for another instruction set silently gives different results or crashes the process, and
    PyTorch's cache key ignores the instruction set. PyTorch's default folder, which it sets itself, is replaced.
    """
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir  # heavy, and needed only to compile

    default_folder = default_cache_dir()
    if os.environ.get(CACHE_VARIABLE, default_folder) == default_folder:
        features = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
        kind = (torch.backends.cpu.get_cpu_capability(), os.environ.get("ONEDNN_MAX_CPU_ISA"), features)
        os.environ[CACHE_VARIABLE] = f"{default_folder}_{crc32(repr(kind).encode()):08x}"
