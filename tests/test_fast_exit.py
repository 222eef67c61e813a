"""How programs end."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import atexit, sys
from threading import Timer
from vla.parallel.fast_exit import fast_exit

class Freed:
    def __del__(self):
        print("freed")

freed = Freed()
with fast_exit():
    atexit.register(print, "handler")
    Timer(0.1, print, ["thread"]).start()
    with fast_exit():
        {last}
"""


@pytest.mark.parametrize(
    ("last", "status", "said"),
    [
        ("pass", 0, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit(130)", 130, ""),
        ("sys.exit('wrong')", 1, "wrong\n"),
        ("raise ValueError('wrong')", 1, "ValueError: wrong\n"),
    ],
)
def test_fast_exit_runs_threads_and_handlers_but_no_finalizers(last: str, status: int, said: str) -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM.format(last=last)], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout) == (status, "thread\nhandler\n")
    assert done.stderr.endswith(said) and bool(done.stderr) == bool(said)


def test_a_closed_output_is_no_error() -> None:
    command = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-c", PROGRAM.format(last="pass")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
