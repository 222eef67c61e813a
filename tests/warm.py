"""Programs in processes of their own that begin with the heavy libraries loaded, which else takes most of their time: a
process that has imported them and done nothing else forks for every one.

MuJoCo is not among them: importing it opens the display, which does not survive a fork.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from socket import create_server
from tempfile import TemporaryDirectory
from typing import Any

from vla.parallel.fast_exit import fast_exit
from vla.parallel.processes import without_triton
from vla.tasks.gl import choose_backend

PATIENCE = 450  # [s]

Meanwhile = Callable[[int], None]  # is given the process


def run(
    folder: Path, *arguments: str, program: str = "vla.run", meanwhile: Meanwhile | None = None
) -> subprocess.CompletedProcess[str]:
    """What `python -m PROGRAM` with these arguments does in a folder, whatever is done to it `meanwhile`."""
    return _done(folder, program, arguments, [{}], meanwhile)[0]


def run_together(folder: Path, program: str, *arguments: str) -> None:
    """Let two processes that find each other, as `torchrun` starts them, run a module of these tests to its end."""
    with create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "NODE_RANK": "0"}
    for done in _done(folder, program, arguments, [{**shared, "LOCAL_RANK": rank} for rank in "01"]):
        assert done.returncode == 0, done.stdout + done.stderr


def _done(
    folder: Path,
    program: str,
    arguments: Sequence[str],
    environments: Sequence[dict[str, str]],
    meanwhile: Meanwhile | None = None,
) -> list[subprocess.CompletedProcess[str]]:
    """Run a program once with each of the additions to the environment, at the same time."""
    with TemporaryDirectory() as scratch:
        files = [[f"{scratch}/{name}{number}" for name in ("out", "err")] for number in range(len(environments))]
        orders = [
            {
                "folder": str(folder),
                "program": program,
                "arguments": arguments,
                "files": each,
                "environment": {**os.environ, **environment},
            }
            for each, environment in zip(files, environments, strict=True)
        ]
        source = _source()
        assert source.stdin is not None and source.stdout is not None
        print(json.dumps(orders), file=source.stdin, flush=True)
        processes = json.loads(source.stdout.readline())
        try:
            if meanwhile:
                meanwhile(*processes)
        finally:
            codes = json.loads(source.stdout.readline())
        texts = [[Path(file).read_text(encoding="utf-8") for file in each] for each in files]
    command = ["python", "-m", program, *arguments]
    return [subprocess.CompletedProcess(command, code, *each) for code, each in zip(codes, texts, strict=True)]


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
    places = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:0] = [order["folder"], *(place for place in places if place and place not in sys.path)]
    for name in [name for name in sys.modules if name.partition(".")[0] == "vla"]:
        del sys.modules[name]  # the folder may have another
    runpy.run_module(order["program"], run_name="__main__", alter_sys=True)


def _codes(processes: list[int]) -> list[int]:
    """How each process ended; those that wait for one that failed are ended."""
    codes: dict[int, int] = {}
    while len(codes) < len(processes):
        process, status = os.wait()
        codes[process] = os.waitstatus_to_exitcode(status)
        for other in processes:
            if codes[process] and other not in codes:
                os.kill(other, signal.SIGKILL)
    return [codes[process] for process in processes]


def read_yaml_faster() -> None:
    """Let OmegaConf read files with libyaml, which saves two fifths of composing."""
    import yaml

    yaml.SafeLoader = yaml.CSafeLoader


def main() -> None:
    """Load the libraries; then, for every line of standard input, fork and tell the processes, then how they ended."""
    choose_backend()
    without_triton()
    read_yaml_faster()
    import lightning
    import matplotlib.figure
    import pyarrow
    import rerun
    import timm  # noqa: F401
    import torch._dynamo
    import torch.utils.tensorboard

    del lightning, matplotlib, pyarrow, rerun, torch
    gc.collect()
    gc.freeze()  # or each process looks through all this again and again, and copies it to do so
    for line in sys.stdin:
        processes = []
        for order in json.loads(line):
            process = os.fork()
            if process == 0:
                _become(order)
                return
            processes.append(process)
        print(json.dumps(processes), flush=True)
        print(json.dumps(_codes(processes)), flush=True)


if __name__ == "__main__":
    with fast_exit():
        main()
