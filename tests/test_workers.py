"""Worker processes: what ends them, and what is heard of it."""

from __future__ import annotations

import os
import resource
import signal
import sys
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import pytest
from collecting import until
from psutil import Process

from vla.io.errors import UserError
from vla.parallel.pool import ProcessPool, WorkerCrash


class Doubling:
    """Doubles numbers; does to its own process what is asked of it."""

    def __init__(self, marker: Path | None = None, status: int | None = None) -> None:
        """Ends the process with exit `status`, or by a signal while there is no `marker`, which it leaves."""
        if status is not None:
            os._exit(status)
        if marker is not None and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    def attempt(self, number: int) -> int:
        """Twice the number; of 7 none, by the end of the process."""
        if number == 7:
            os.kill(os.getpid(), signal.SIGSEGV)
        if number == 8:
            raise Awkward("eight", 8)
        if number == 9:
            return lambda: number  # type: ignore[return-value]
        return 2 * number

    def close(self) -> None:
        """Nothing to free."""


class Awkward(Exception):
    """Cannot be unpickled."""

    def __init__(self, text: str, number: int) -> None:
        super().__init__(f"{text} is {number}")


def results(make: Any, *numbers: int) -> list[Any]:
    """What becomes of the numbers, exceptions included."""
    with ProcessPool(make, 2) as pool:
        futures = [pool.submit(number) for number in numbers]
        found = [future.exception() or future.result() for future in futures]
    assert not active_children()
    return found


def test_only_the_item_that_crashes_its_process_twice_is_lost() -> None:
    one, lost, *others = results(Doubling, 1, 7, 2, 3)
    assert (one, *others) == (2, 4, 6)
    assert isinstance(lost, WorkerCrash) and str(lost).startswith(
        "a worker process crashed twice: it was ended by signal 11 ("
    )


class Numbered(Doubling):
    """Leaves the number of its worker in a folder, and waits until every worker has left one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def attempt(self, number: int) -> int:
        (self._folder / os.environ["VLA_WORKER"]).touch()
        until(lambda: len([*self._folder.iterdir()]) == 2)
        return number


def test_workers_are_numbered(tmp_path: Path) -> None:
    assert results(partial(Numbered, tmp_path), 4, 5) == [4, 5]
    assert {path.name for path in tmp_path.iterdir()} == {"0", "1"}


def test_an_error_or_result_that_cannot_be_sent_is_told_in_words_and_no_crash() -> None:
    one, error, other = results(Doubling, 1, 8, 9)
    assert one == 2 and type(error) is RuntimeError and str(error) == "Awkward: eight is 8"
    assert not isinstance(other, WorkerCrash) and "pickle" in str(other)


def test_a_process_that_is_killed_while_it_starts_is_replaced(tmp_path: Path) -> None:
    assert results(partial(Doubling, marker=tmp_path / "killed"), 1) == [2]


def test_a_process_that_cannot_start_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    (ended,) = results(partial(Doubling, status=3), 1)
    assert type(ended) is UserError and "could not start: it ended with exit status 3, see its output" in str(ended)
    assert "cluster.workers=1" in str(ended)
    only_here = ModuleType("only_here")
    only_here.Doubling = type("Doubling", (Doubling,), {"__module__": "only_here"})  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "only_here", only_here)
    (missing,) = results(only_here.Doubling, 1)
    assert isinstance(missing, ModuleNotFoundError) and "only_here" in str(missing)


def test_processes_that_crash_leave_no_file_open() -> None:
    open_files = list[int]()
    with ProcessPool(Doubling, 1) as pool:
        for number in (1, 7, 1, 7, 1):
            pool.submit(number).exception()
            open_files.append(Process().num_fds())
    assert open_files[0] == open_files[2] == open_files[4]


def test_many_workers_may_open_many_files(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = list[tuple[int, int]]()
    monkeypatch.setattr(resource, "setrlimit", lambda _, pair: limits.append(pair))
    for pair in ((1024, 524288), (1024, resource.RLIM_INFINITY), (1024, 4096), (20000, 20000), (1024, 1024)):
        monkeypatch.setattr(resource, "getrlimit", lambda _, pair=pair: pair)
        with ProcessPool(partial(Mock), 2):
            pass
    assert limits == [(8192, 524288), (8192, resource.RLIM_INFINITY), (4096, 4096)]
