"""Programs in processes of their own that begin with the heavy libraries loaded, which else takes most of their time: a
process that has imported them and done nothing else forks for every one. All workers of a test run share it.

MuJoCo is not among them: importing it opens the display, which does not survive a fork.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import pickle
import runpy
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from select import select
from socket import AF_UNIX, create_server, socket
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, TextIO
from unittest.mock import patch

from vla.parallel.processes import ease_garbage_collection, without_triton
from vla.tasks.gl import choose_backend

CONF = str(Path(__file__).parents[1] / "conf")
PATIENCE = 450  # [s]
SOURCE = "VLA_TESTS_SOURCE"  # environment variable: the socket at which the process listens

Meanwhile = Callable[[int], None]  # is given the process


def run(
    folder: Path, *arguments: str, program: str = "vla.run", meanwhile: Meanwhile | None = None
) -> subprocess.CompletedProcess[str]:
    """What `python -m PROGRAM` with these arguments does in a folder, whatever is done to it `meanwhile`."""
    return _done(folder, program, arguments, [{}], meanwhile)[0]


class Started:
    """`python -m PROGRAM` while it runs, with what tests need of `subprocess.Popen`."""

    def __init__(self, folder: Path, program: str, *arguments: str, environment: dict[str, str]) -> None:
        """Run it in a folder, with these additions to the environment."""
        process: Future[int] = Future()
        thread = ThreadPoolExecutor(1)
        self._done = thread.submit(_done, folder, program, arguments, [environment], process.set_result)
        thread.shutdown(wait=False)
        self._process = process.result(PATIENCE)

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if not self._done.done():
            os.kill(self._process, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """How it ended, within some seconds."""
        return self._done.result(timeout)[0].returncode

    def printed(self, timeout: float | None = None) -> str:
        """What it printed until its end, within some seconds: errors first."""
        (done,) = self._done.result(timeout)
        return done.stderr + done.stdout


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
        with _source() as source:
            print(json.dumps(orders), file=source, flush=True)
            processes = json.loads(source.readline())
            try:
                if meanwhile:
                    meanwhile(*processes)
            finally:
                codes = json.loads(source.readline())
        texts = [[Path(file).read_text(encoding="utf-8") for file in each] for each in files]
    command = ["python", "-m", program, *arguments]
    return [subprocess.CompletedProcess(command, code, *each) for code, each in zip(codes, texts, strict=True)]


def start() -> None:
    """Start the process, which loads the libraries when it is first needed and ends with this one."""
    folder = mkdtemp(prefix="started-by-tests-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[SOURCE] = f"{folder}/socket"
    with socket(AF_UNIX) as server:
        server.bind(os.environ[SOURCE])
        server.listen()
        command = [sys.executable, __file__, str(server.fileno())]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[server.fileno()], start_new_session=True)
    atexit.register(process.kill)


def _source() -> TextIO:
    """A connection to the process."""
    if SOURCE not in os.environ:
        start()
    with socket(AF_UNIX) as connection:
        connection.connect(os.environ[SOURCE])
        return connection.makefile("rw", encoding="utf-8")  # which keeps it open


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


def compose_faster() -> None:
    """Leave out what takes Hydra and OmegaConf more than half of their time and changes nothing.

    OmegaConf reads files without libyaml, and tells every node its parent after each merge, whether it has one already
    or not. Hydra makes a config of all choices for every file, in case its defaults refer to one, and for every
    composition reads all files again and copies all that knows where they are.
    """
    import yaml
    from hydra._internal import defaults_list
    from hydra._internal.config_repository import ConfigRepository
    from hydra.core.object_type import ObjectType
    from omegaconf.base import Box

    from vla.config.compose import copy_less

    copy_less()
    choices, tell, load = defaults_list._create_interpolation_map, Box._re_parent, ConfigRepository.load_config
    loaded: dict[str, bytes] = {}

    def once(repository: ConfigRepository, config_path: str) -> Any:
        source = repository._find_object_source(config_path, ObjectType.CONFIG)
        if source is None or source.path not in (CONF, "hydra.conf"):
            return load(repository, config_path)
        if config_path not in loaded:
            loaded[config_path] = pickle.dumps(load(repository, config_path))
        return pickle.loads(loaded[config_path])  # as the composition changes it

    def if_needed(overrides: Any, entries: list[Any], self_added: bool) -> Any:
        return choices(overrides, entries, self_added) if any(each.is_interpolation() for each in entries) else None

    def if_new(box: Box) -> None:
        content: Any = box.__dict__["_content"]
        if not isinstance(content, dict | list):
            tell(box)
            return
        for node in content.values() if isinstance(content, dict) else content:
            if node.__dict__["_parent"] is not box:
                node._set_parent(box)
            if isinstance(node, Box):
                if_new(node)

    yaml.SafeLoader = yaml.CSafeLoader
    patch.object(ConfigRepository, "load_config", once).start()
    patch.object(defaults_list, "_create_interpolation_map", if_needed).start()
    patch.object(Box, "_re_parent", if_new).start()


def load() -> None:
    """Import the heavy libraries."""
    ease_garbage_collection()
    choose_backend()
    without_triton()
    compose_faster()
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


def serve(connection: TextIO) -> None:
    """Fork for every order in a line, and tell the processes, then how they ended."""
    processes = []
    for order in json.loads(connection.readline()):
        process = os.fork()
        if process == 0:
            _become(order)
            return
        processes.append(process)
    print(json.dumps(processes), file=connection, flush=True)
    print(json.dumps(_codes(processes)), file=connection, flush=True)


def main(server: socket) -> None:
    """Serve every connection in a process of its own, until the process that started this one has ended."""
    loaded = False
    while sys.stdin not in select([server, sys.stdin], [], [])[0]:
        connection, _ = server.accept()
        if not loaded:
            load()
            loaded = True
        with connection:
            if os.fork() == 0:
                serve(connection.makefile("rw", encoding="utf-8"))
                return
        with suppress(ChildProcessError):  # none is left
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


if __name__ == "__main__":
    main(socket(fileno=int(sys.argv[1])))
