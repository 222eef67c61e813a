"""The benchmarked machine, and its load from other programs."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from vla.parallel.limits import cores, processor, processor_facts

# Vector instructions that kernels and compilers choose by, from old to new: of x86, then of ARM.
INSTRUCTIONS = ("sse4_2", "avx", "avx2", "avx512f", "avx512_bf16", "amx_bf16", "asimd", "sve", "bf16")
BUSY = 0.05  # share of all cores that spoils a figure when other programs use it
TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100  # of /proc/stat [1/s]


def machine() -> dict[str, Any]:
    """Return the processor's name, its vector instructions and the number of cores that this process may use."""
    told = processor_facts()
    flags = (told.get("flags") or told.get("Features") or "").split()
    return {
        "processor": processor(),
        "instructions": [each for each in INSTRUCTIONS if each in flags],
        "cores": cores(),
    }


class OtherLoad:
    """Meter of the CPU time of other programs; child processes of this one count as others until they have ended."""

    def __init__(self) -> None:
        self._start = self._now()

    def cores(self) -> float | None:
        """Return how many cores other programs have used on average since the start; None where nothing tells."""
        if self._start is None or (now := self._now()) is None:
            return None
        (busy, own, clock), (busy_before, own_before, before) = now, self._start
        return max(0.0, (busy - busy_before) - (own - own_before)) / max(clock - before, 1e-9)

    def _now(self) -> tuple[float, float, float] | None:
        """Return the busy time of all cores, that of this process and its children, and the time [s]."""
        file = Path("/proc/stat")
        if not file.exists():
            return None
        user, nice, system, _, _, irq, softirq, steal = map(int, file.read_text(encoding="utf-8").split()[1:9])
        return (user + nice + system + irq + softirq + steal) / TICKS, sum(os.times()[:4]), time.monotonic()


def is_unreliable(others: float) -> bool:
    """Return whether other programs used so many cores that the measurements are unreliable."""
    return others > BUSY * (os.cpu_count() or 1)
