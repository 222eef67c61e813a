"""Another project at the same work, in processes of its own Python."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

from vla.workers import one_thread_each

PATIENCE = 20.0  # with another project [s]


def peer(name: str, python: str, script: str, arguments: Sequence[Any], processes: int = 1) -> float:
    """What so many processes of a script in `vla/peers`, side by side, reach together.

    Raises:
        ValueError: it does not run with the Python that `benchmark.NAME` is.
    """
    command = [python, str(Path(__file__).parent / script), *map(str, arguments)]
    with one_thread_each():
        try:
            started = [Popen(command, stdout=PIPE, stderr=PIPE, text=True) for _ in range(processes)]
        except OSError as error:
            raise ValueError(f"benchmark.{name} is {python}, which cannot be run: {error.strerror}") from error
        told = [process.communicate() for process in started]
    if any(process.returncode for process in started):
        last = told[0][1].strip().splitlines()[-1:] or ["it says nothing"]
        raise ValueError(f"benchmark.{name} is {python}, with which {name} does not run: {last[0]}")
    return sum(float(printed.split()[-1]) for printed, _ in told)
