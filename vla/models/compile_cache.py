"""The cache of graphs that PyTorch compiles, one per instruction set."""

from __future__ import annotations

import os
from zlib import crc32

import torch

CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"


def set_compile_cache() -> None:
    """Set PyTorch's cache folder of compiled graphs, unless it is set, to one per instruction set.

    A graph that was compiled for another instruction set silently computes other results or ends the process, and
    PyTorch's cache key ignores the instruction set. PyTorch's own folder, which it sets itself, counts as none.
    """
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir  # heavy: only for who compiles

    shared = default_cache_dir()
    if os.environ.get(CACHE_VARIABLE, shared) == shared:
        features = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
        kind = (torch.backends.cpu.get_cpu_capability(), os.environ.get("ONEDNN_MAX_CPU_ISA"), features)
        os.environ[CACHE_VARIABLE] = f"{shared}_{crc32(repr(kind).encode()):08x}"
