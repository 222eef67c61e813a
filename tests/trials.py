"""A command as a trial: a process of its own, and in which way it ended."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Timer
from typing import Any

import warm

SMALL = ("task.image_size=[32,32]", "task.shadows=false", "collect.episodes=12", "cluster.workers=2")
TRAIN = (*SMALL, "job=train", "validate.episodes=0", "data.batch_size=4", "trainer.max_steps=4")
TRAIN += ("trainer.accelerator=cpu",)
EVALUATE = ("evaluate.episodes=1", "cluster.workers=1", "recorder=none")
CHECKPOINT = "run"
LIMIT = 100.0  # [s] that a command may take

Trials = Iterator[tuple[str, bool, str]]  # what was tried, whether it held, and how it ended


def run(
    folder: Path,
    *arguments: str,
    program: str = "vla.run",
    limit: float = LIMIT,
    before: Callable[[], object] | None = None,
) -> tuple[str, str]:
    """How `python -m PROGRAM …` ended ("sentence", "done", "traceback", "silent", "late"), and what it printed.

    The process starts with the heavy libraries loaded, unless something has to happen `before` it runs.
    """
    if before is None:
        late: list[int] = []

        def end(process: int) -> None:
            late.append(process)
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)

        timers: list[Timer] = []

        def watch(process: int) -> None:
            timers.append(Timer(limit, end, [process]))
            timers[0].start()

        done = warm.run(folder, *arguments, program=program, meanwhile=watch)
        timers[0].cancel()
        return ended(done.returncode, done.stdout + done.stderr, bool(late))
    command = [sys.executable, "-m", program, *arguments]
    both: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, cwd=folder, text=True, start_new_session=True, preexec_fn=before, **both) as process:
        try:
            printed, late_too = process.communicate(timeout=limit)[0], False
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            printed, late_too = process.communicate()[0], True
    return ended(process.returncode, printed, late_too)


def ended(code: int, printed: str, late: bool = False) -> tuple[str, str]:
    """In which way a command ended, and what it printed."""
    sentences = [line for line in printed.splitlines() if line.startswith("error: ")]
    if late:
        return "late", printed
    if "Traceback (most recent call last)" in printed:
        return "traceback", printed
    if code == 0:
        return "done", printed
    return ("sentence" if len(sentences) == 1 else "silent"), printed


def digest(folder: Path, *suffixes: str) -> dict[str, str]:
    """File → hash of a folder's files, or of those that end in `suffixes`."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and (not suffixes or path.suffix in suffixes)]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def last(printed: str) -> str:
    """The sentence that a command ended with, or its last line."""
    lines = [line for line in printed.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return re.sub(r"\s+", " ", (errors or lines or [""])[-1])[:300]
