"""Throughput of another project on the same work, in processes of its own Python interpreter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

from vla.io.errors import UserError
from vla.parallel.processes import one_thread_each

DURATION = 20.0  # of the measurement of another project [s]


def peer(name: str, python: str, script: str, arguments: Sequence[Any], processes: int = 1) -> float:
    """Return the total throughput of concurrent processes of a script in this folder, which prints its rate.

    Args:
        name: of the project, and of the key of its interpreter in the node `benchmark`.
        python: that interpreter.
        script: name of the file.
        arguments: of the script.
        processes: their number.

    Raises:
        UserError: the interpreter or the script fails.
    """
    command = [python, str(Path(__file__).parent / script), *map(str, arguments)]
    with one_thread_each():
        try:
            started = [Popen(command, stdout=PIPE, stderr=PIPE, text=True) for _ in range(processes)]
        except OSError as error:
            raise UserError(f"benchmark.{name} is {python}, which cannot be run: {error.strerror}") from error
        outputs = [process.communicate() for process in started]
    failed = [errors for process, (_, errors) in zip(started, outputs, strict=True) if process.returncode]
    if failed:
        last = failed[0].strip().splitlines()[-1:] or ["no output"]
        raise UserError(f"benchmark.{name} is {python}, with which {name} does not run: {last[0]}")
    return sum(float(printed.split()[-1]) for printed, _ in outputs)
