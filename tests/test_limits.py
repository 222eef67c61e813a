"""Cores and memory that a container or a batch job leaves to its processes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import psutil
import pytest

from vla.parallel import limits


def group(folder: Path, files: Mapping[str, str]) -> None:
    """Write the files of a control group."""
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_text(content)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with most of its memory free and with no control group yet."""
    idle = psutil.virtual_memory()._replace(available=90, total=100)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: idle)
    monkeypatch.setattr(limits, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(limits, "MEMBERSHIP", tmp_path / "membership")
    return tmp_path / "cgroup"


def test_without_control_groups_the_memory_is_that_of_the_machine(root: Path) -> None:
    assert limits.free_memory() == 90 and limits.memory() == 100
    limits.MEMBERSHIP.write_text("0::/user.slice\n")  # no such folder: the files are those of another container
    assert limits.free_memory() == 90


def test_the_tightest_of_nested_groups_counts(root: Path) -> None:
    limits.MEMBERSHIP.write_text("0::/job/step\n")
    unlimited = {"memory.max": "max\n", "memory.current": "70\n", "memory.stat": "anon 60\ninactive_file 10\n"}
    group(root / "job" / "step", unlimited)
    assert limits.free_memory() == 90 and limits.memory() == 100
    (root / "job" / "memory.max").write_text("80\n")
    (root / "job" / "memory.current").write_text("70\n")
    (root / "job" / "memory.stat").write_text("anon 60\ninactive_file 10\n")
    assert limits.memory() == 80
    assert limits.free_memory() == 20  # 60 of 80 are in use; the kernel drops files that nobody reads
    assert limits.is_memory_scarce(0.26) and not limits.is_memory_scarce(0.25)


def test_a_small_group_on_a_full_machine_has_what_the_smaller_of_both_leaves(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the product of the smallest share and the smallest limit, 0.1 of 16."""
    full = psutil.virtual_memory()._replace(available=51, total=512)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: full)
    limits.MEMBERSHIP.write_text("0::/job\n")
    group(root / "job", {"memory.max": "16\n", "memory.current": "4\n", "memory.stat": "inactive_file 0\n"})
    assert limits.free_memory() == 12 and limits.memory() == 16


def test_version_1_is_read_at_the_place_of_its_controller(root: Path) -> None:
    limits.MEMBERSHIP.write_text("9:name=systemd:/\n4:memory:/box\n1:cpu:/\n")
    files = {"memory.limit_in_bytes": "200\n", "memory.usage_in_bytes": "150\n", "memory.stat": "inactive_file 1\n"}
    group(root / "memory" / "box", {**files, "memory.stat": "inactive_file 1\ntotal_inactive_file 50\n"})
    assert limits.free_memory() == 90
    (root / "memory" / "box" / "memory.usage_in_bytes").write_text("240\n")
    assert limits.free_memory() == 10
    (root / "memory" / "box" / "memory.limit_in_bytes").write_text("40\n")
    assert limits.memory() == 40
    (root / "memory" / "box" / "memory.limit_in_bytes").write_text("9223372036854771712\n")  # its way to say unlimited
    assert limits.free_memory() == 90


def test_cores_are_those_that_this_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 1 <= limits.cores() <= len(os.sched_getaffinity(0))
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    assert limits.cores() == 1
