"""What `torch.compile` needs to give right results: a cache per instruction set, and vectors that GCC handles."""

from __future__ import annotations

import os
from zlib import crc32

import torch

CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"
VECTOR = 256  # bits of the vectors that GCC is given on a processor that has wider ones


def prepare_compilation() -> None:
    """Set what PyTorch compiles for, and where it caches it, unless the user has set these."""
    _set_cache()
    _limit_vectors()


def _set_cache() -> None:
    """Set PyTorch's cache folder of compiled graphs to one per instruction set.

    A graph compiled for another instruction set silently gives different results or crashes the process, and
    PyTorch's cache key ignores the instruction set. PyTorch's default folder, which it sets itself, is replaced.
    """
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir  # heavy, and needed only to compile

    default_folder = default_cache_dir()
    if os.environ.get(CACHE_VARIABLE, default_folder) == default_folder:
        features = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
        kind = (torch.backends.cpu.get_cpu_capability(), os.environ.get("ONEDNN_MAX_CPU_ISA"), features)
        os.environ[CACHE_VARIABLE] = f"{default_folder}_{crc32(repr(kind).encode()):08x}"


def _limit_vectors() -> None:
    """Let PyTorch generate C++ without AVX-512, unless the compiler is Clang.

    GCC 12.2 with -O3 miscompiles generated sums over transposed bfloat16 numbers for some processors, such as Intel's
    Sapphire Rapids: gradients of `bc` are wrong or not finite. With -fno-tree-slp-vectorize they are right, but PyTorch
    takes no further options.
    """
    from torch._inductor import config

    has_avx512 = torch.backends.cpu.get_cpu_capability() == "AVX512"
    if has_avx512 and config.cpp.simdlen is None and "clang" not in os.environ.get("CXX", "g++"):
        config.cpp.simdlen = VECTOR
