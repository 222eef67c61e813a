"""The command line in processes of their own that begin with the heavy libraries loaded, which else takes most of their
time: a process that has imported them and done nothing else forks for every command.

MuJoCo is not among them: importing it opens the display, which does not survive a fork.
"""

from __future__ import annotations

import atexit
import json
import os
import runpy
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

PATIENCE = 300  # [s]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """What `python -m vla.run` with these arguments does in a folder."""
    with TemporaryDirectory() as scratch:
        files = [f"{scratch}/{name}" for name in ("stdout", "stderr")]
        order = {"folder": str(folder), "arguments": arguments, "files": files, "environment": dict(os.environ)}
        source = _source()
        assert source.stdin is not None and source.stdout is not None
        print(json.dumps(order), file=source.stdin, flush=True)
        code = int(source.stdout.readline())
        texts = [Path(file).read_text(encoding="utf-8") for file in files]
    return subprocess.CompletedProcess(["python", "-m", "vla.run", *arguments], code, *texts)


@cache
def _source() -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    atexit.register(process.kill)
    return process


def _become(order: dict[str, Any]) -> None:
    """Turn this process into the one that was ordered."""
    signal.alarm(PATIENCE)  # ends it
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    for number, file in enumerate([os.devnull, *order["files"]]):
        opened = os.open(file, os.O_RDWR | os.O_CREAT, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    sys.argv[1:] = order["arguments"]
    sys.path[0] = order["folder"]
    runpy.run_module("vla.run", run_name="__main__", alter_sys=True)


def main() -> None:
    """Load the libraries; then, for every line of standard input, fork and answer with the exit status."""
    import lightning
    import matplotlib.figure
    import pyarrow
    import rerun
    import timm  # noqa: F401
    import torch._dynamo
    import torch.utils.tensorboard

    del lightning, matplotlib, pyarrow, rerun, torch
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            _become(json.loads(line))
            return
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
