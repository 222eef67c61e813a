"""Cores and memory available to this process, as limited by the machine, its container or batch job."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from pathlib import Path

import psutil

CGROUPS, MEMBERSHIP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# Files of limit and usage, and the key in `memory.stat` for the usage that the kernel reclaims when memory is needed.
MEMORY_FILES = (
    ("memory.max", "memory.current", "inactive_file"),  # version 2
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # version 1
)


def cores() -> int:
    """Return the number of cores that processes may use by CPU affinity, container's quota and `LOKY_MAX_CPU_COUNT`."""
    from loky import cpu_count  # takes a twentieth of a second

    return int(cpu_count())


def processor() -> str:
    """Return the name of the processor."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    facts = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    return facts.get("model name") or platform.processor() or platform.machine()


def free_memory() -> int:
    """Return the free memory [bytes] of the machine, or of the control group (of a container or job) with the least."""
    return min(free for _, free in _limits())


def is_memory_scarce(share: float) -> bool:
    """Return whether less than a share of the memory is free, of the machine or of a control group."""
    return any(free < share * total for total, free in _limits())


def memory() -> int:
    """Return the memory [bytes] of the machine, or of the control group that has the least."""
    return min(total for total, _ in _limits())


def _limits() -> Iterator[tuple[int, int]]:
    """Yield the whole memory and the free part of it [bytes], of the machine and of each limited control group of this
    process, their parents included."""
    machine = psutil.virtual_memory()
    yield machine.total, machine.available
    lines = MEMBERSHIP.read_text().splitlines() if MEMBERSHIP.exists() else []
    for _, controllers, path in (line.split(":", 2) for line in lines):
        if controllers in ("", "memory"):
            root = CGROUPS / controllers
            group = root / path.lstrip("/")
            for folder in (group, *group.parents):
                if folder.is_relative_to(root):
                    yield from _group_limit(folder)


def _number(file: Path) -> int | None:
    """Return the number in a file; None if it holds none, such as the `max` of an unlimited group."""
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return None


def _group_limit(group: Path) -> Iterator[tuple[int, int]]:
    """Yield the whole memory and the free part of it [bytes] of a control group if it is limited."""
    for limit, used, droppable in MEMORY_FILES:
        total, usage = _number(group / limit), _number(group / used)
        try:
            statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):
            statistics = {}
        if total and usage is not None:
            yield total, max(0, total - usage + int(statistics.get(droppable, 0)))
