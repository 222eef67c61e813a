"""What a stage reports: a value and the floor that was measured beside it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

Measure = dict[str, Any]  # value, unit, n, floor, ratio


def measure(value: float, unit: str, n: int, floor: float) -> Measure:
    """A value that was measured on `n` of something, beside its floor."""
    return {"value": round(value, 2), "unit": unit, "n": n, "floor": round(floor, 2), "ratio": round(value / floor, 3)}


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What comes of some work, and how long it took [s]."""
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started
