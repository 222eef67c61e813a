"""Result of a measurement: a value and its floor."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

Measure = dict[str, Any]  # value, unit, n, floor, ratio, in this order


@runtime_checkable
class HasMinimalStep(Protocol):
    """A world that can run the unavoidable part of a control step by itself."""

    def minimal_step(self) -> dict[str, Callable[[], object]]:
        """Return "physics" and "rendering" → a function that does this part of a control step, and changes no state."""
        ...


def measure(value: float, unit: str, n: int, floor: float | None) -> Measure:
    """Return the measure of a value over `n` repetitions, rounded; `floor` is None if there is none."""
    beside = (None, None) if floor is None else (round(floor, 2), round(value / floor, 3))
    return {"value": round(value, 2), "unit": unit, "n": n, "floor": beside[0], "ratio": beside[1]}


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of `work` and its duration [s]."""
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started
