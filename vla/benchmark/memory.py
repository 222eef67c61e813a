"""The memory of a training at its fullest."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path

import torch


def forget_peak(device: torch.device) -> float:
    """From here on a new peak counts; what of it is held already, for other purposes [B]."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return 0.0
    ctypes.CDLL(None).malloc_trim(0)  # what is free but not given back would count
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _status()["RssAnon"]


def peak(device: torch.device) -> float:
    """The most memory since then [B]: allocated on a GPU; else of the process, without what it maps from files, the
    demonstrations among it."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = _status()
    return status["VmHWM"] - status["RssFile"]


def _status() -> dict[str, float]:
    """Sizes of this process [B], as proc(5) names them."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return {line.partition(":")[0]: 1024.0 * int(line.split()[1]) for line in lines if line.endswith(" kB")}
