"""A measurement beside its floor, the machine that it is made on, and other projects as floors."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any, Protocol, runtime_checkable

import psutil
import torch

from vla.io.errors import UserError
from vla.parallel.limits import cores, processor
from vla.parallel.processes import one_thread_each

Measure = dict[str, Any]  # value, unit, n, floor, ratio, in this order

BUSY = 0.05  # share of all cores that spoils a figure when other programs use it
PEERS = Path(__file__).parents[3] / "tools/peers"  # of the repository
DURATION = 20.0  # of the measurement of another project [s]


@runtime_checkable
class HasMinimalStep(Protocol):
    """A world that can run the unavoidable part of a control step by itself."""

    def minimal_step(self) -> dict[str, Callable[[], object]]:
        """Return "physics" and "rendering" → a function that does this part of a step, and changes no state."""
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


def machine() -> dict[str, Any]:
    """Return the processor's name, the vector instructions that kernels use, and how many cores this process may."""
    instructions = torch.backends.cpu.get_cpu_capability()
    return {"processor": processor(), "instructions": instructions, "cores": cores()}


class OtherLoad:
    """Meter of the CPU time of other programs; child processes of this one count as others until they have ended."""

    def __init__(self) -> None:
        self._start = self._now()

    def cores(self) -> float:
        """Return how many cores other programs have used on average since the start."""
        others, clock = (now - before for now, before in zip(self._now(), self._start, strict=True))
        return max(0.0, others) / max(clock, 1e-9)

    def _now(self) -> tuple[float, float]:
        """Return the busy time of all cores but for that of this process and its children, and the time [s]."""
        times = psutil.cpu_times()
        idle = times.idle + getattr(times, "iowait", 0.0) + getattr(times, "guest", 0.0)
        return sum(times) - idle - sum(os.times()[:4]), time.monotonic()


def peer(name: str, python: str, script: str, arguments: Sequence[Any], processes: int = 1) -> float:
    """Return the total throughput of another project: of concurrent processes of a script in `PEERS`.

    Raises:
        UserError: the interpreter `python`, which is that of `benchmark.NAME`, or the script fails.
    """
    command = [python, str(PEERS / script), *map(str, arguments)]
    with one_thread_each():
        try:
            started = [Popen(command, stdout=PIPE, stderr=PIPE, text=True) for _ in range(processes)]
        except OSError as error:
            raise UserError(f"benchmark.{name} is {python}, which cannot be run: {error.strerror}") from error
        outputs = [process.communicate() for process in started]
    for process, (_, errors) in zip(started, outputs, strict=True):
        if process.returncode:
            raise UserError(f"benchmark.{name} is {python}, with which {name} does not run: {errors.strip()[-200:]}")
    return sum(float(printed.split()[-1]) for printed, _ in outputs)
