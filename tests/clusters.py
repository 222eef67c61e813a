"""Processes of a Dask cluster on this machine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import toy

PLACES = os.pathsep.join([str(Path(toy.__file__).parent), str(Path(toy.__file__).parents[1])])


Process = subprocess.Popen[bytes]


@contextmanager
def dask(*arguments: str, **environment: str) -> Iterator[Process]:
    """A `dask …` process that can import the toy world, killed at the end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments],
        env={**os.environ, "PYTHONPATH": PLACES, **environment},
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def address_in(file: Path) -> str:
    """The address that a scheduler is about to write to a file."""
    until(lambda: file.exists() and file.read_text().rstrip().endswith("}"))
    address: str = json.loads(file.read_text())["address"]
    return address


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds, or fail after two minutes."""
    give_up = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.01)
