"""Measurements with their floors, and the machine on which they are made."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import psutil
import torch

from vla.parallel.limits import cores, processor

Measure = dict[str, Any]  # value, unit, n, floor, ratio, in this order


def measure(value: float, unit: str, n: int, floor: float | None) -> Measure:
    """Return the measure of a value over `n` repetitions, rounded; `floor` is None if there is none."""
    reference = (None, None) if floor is None else (round(floor, 2), round(value / floor, 3))
    return {"value": round(value, 2), "unit": unit, "n": n, "floor": reference[0], "ratio": reference[1]}


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of `work` and its duration [s]."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def machine() -> dict[str, Any]:
    """Return the processor's name, the vector instructions that kernels use, and the number of usable cores."""
    instructions = torch.backends.cpu.get_cpu_capability()
    return {"processor": processor(), "instructions": instructions, "cores": cores()}


def other_load() -> tuple[float, float]:
    """Return the busy time of all cores, without that of this process and its ended children, and the time [s].

    The quotient of their differences between two calls is the number of cores that other programs used meanwhile.
    """
    times = psutil.cpu_times()
    idle = times.idle + getattr(times, "iowait", 0.0) + getattr(times, "guest", 0.0)
    return sum(times) - idle - sum(os.times()[:4]), time.monotonic()
