"""Peak memory of a training."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path

import torch


def reset_peak(device: torch.device) -> float:
    """Reset the peak; returns the memory [B] that is already in use, to be subtracted from the next peak."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return 0.0
    ctypes.CDLL(None).malloc_trim(0)  # freed memory that is not returned to the kernel would count
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _status()["RssAnon"]


def peak(device: torch.device) -> float:
    """Return the peak memory since `reset_peak` [B]: of allocations on a GPU, otherwise of the process.

    Memory-mapped files, such as the demonstrations, do not count.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = _status()
    return status["VmHWM"] - status["RssFile"]


def _status() -> dict[str, float]:
    """Return name → size of this process [B], see proc(5)."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return {line.partition(":")[0]: 1024.0 * int(line.split()[1]) for line in lines if line.endswith(" kB")}
