"""Clock and memory of the device of a training."""

from __future__ import annotations

import resource
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import torch

from vla.parallel.limits import free_memory


def synchronized_time(device: torch.device) -> float:
    """Wait for the work of a device and return the time [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def memory_of(device: torch.device) -> tuple[float, float]:
    """Return the memory that this process holds, see `peak`, and the memory that is free for it [bytes]."""
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device), torch.cuda.mem_get_info(device)[0]
    return psutil.Process().memory_info().rss - _file_memory(), free_memory()


def peak(device: torch.device) -> float:
    """Return the largest memory of this process since `reset_peak` [bytes].

    On Linux, file-backed pages, such as those of a memory-mapped store, do not count: the system can reclaim them.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return largest - _file_memory()


def reset_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with suppress(OSError):  # not on Linux, or forbidden: the peak since the start of the process counts
        Path("/proc/self/clear_refs").write_text("5")


def _file_memory() -> int:
    """Return the file-backed memory of this process [bytes]; 0 where it is unknown."""
    return getattr(psutil.Process().memory_info(), "shared", 0)
