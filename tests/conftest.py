"""Shared by all tests: headless rendering, one thread per process, the tabletop as the configuration builds it, and a
store of episodes of the toy world."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from functools import cache
from itertools import cycle
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

import pytest
import warm
from filelock import FileLock

from vla.parallel.processes import THREAD_SETTINGS, ease_garbage_collection, without_triton
from vla.tasks.gl import choose_backend, has_egl

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from world import World

    from vla.tasks.tabletop.environment import Tabletop

# Domains of ROS for the tests of this worker, one after the other; test_deploy has one of its own.
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 3
domains = cycle(range(1 + 33 * WORKER, 33 + 33 * WORKER))

CONF = Path(__file__).parents[1] / "conf"

# Read by libraries when they are first imported, which tests do after this file.
for name, threads in THREAD_SETTINGS.items():
    os.environ.setdefault(name, threads)
os.environ["CUDA_VISIBLE_DEVICES"] = ""  # the tests are of the CPU, also beside a GPU
choose_backend()
has_egl()  # once, for the programs that tests start
without_triton()

warm.compose_faster()
ease_garbage_collection()

# What a shell runs in the background ignores interrupts, and so would the programs that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Compiled graphs are kept in a folder of this run, not in one that other processors and versions have filled.

    Programs start from one process, which all workers share.
    """
    if "TORCHINDUCTOR_CACHE_DIR" not in os.environ:
        folder = os.environ["TORCHINDUCTOR_CACHE_DIR"] = mkdtemp(prefix="compiled-by-tests-")  # workers inherit it
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    if "PYTEST_XDIST_WORKER" not in os.environ:
        warm.start()


def pytest_collection_finish() -> None:
    """Freeze all imported objects, so that the garbage collector does not scan them again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that the test has saved so far."""
    from matplotlib.figure import Figure

    saved: list[Figure] = []
    write = Figure.savefig

    def savefig(figure: Figure, *arguments: Any, **options: Any) -> None:
        saved.append(figure)
        write(figure, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return saved


def make_tabletop(*overrides: str) -> Tabletop:
    """The environment that `overrides` of the default configuration compose to."""
    from composing import composed
    from hydra.utils import instantiate

    environment: Tabletop = instantiate(composed(*overrides).task, _convert_="all")
    return environment


@pytest.fixture(scope="module")
def tabletop() -> Iterator[Tabletop]:
    """The default task, for tests that do not change it."""
    environment = make_tabletop()
    yield environment
    environment.close()


@pytest.fixture
def recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording in place of any that a configuration names, in the layout of an SO-101 with two cameras."""
    from vla.data.formats.imported_demonstrations import Recording

    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    names = tuple(f"{joint}.pos" for joint in joints)
    found = Recording(("front", "wrist"), 30.0, names, names, dict.fromkeys(names, (-90.0, 90.0)), 50)
    monkeypatch.setattr("vla.config.resolvers._recording", lambda expert: found)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that the first of all workers has filled; the others wait, and nobody changes it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with FileLock(f"{folder}.lock"):
        if not Path(f"{folder}.made").exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a worker that failed
            folder.mkdir()
            make(folder)
            Path(f"{folder}.made").touch()
    return folder


@pytest.fixture(scope="session")
def faster_exports() -> Iterator[None]:
    """PyTorch collects the functions of ONNX once, not for every export."""
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib)))
        yield


@pytest.fixture(scope="session")
def action_packages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The packages control_msgs and franka_msgs of ROS 2 can be imported."""
    import action_messages

    folder = str(made_once(tmp_path_factory, "action_messages", action_messages.make))
    sys.path.append(folder)
    yield
    sys.path.remove(folder)


@pytest.fixture(scope="session")
def main_job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one small main job, in `run`, and of what it printed; to be copied."""
    import command_line

    def work(folder: Path) -> None:
        done = command_line.vla(folder, *command_line.SMALL, "validate.episodes=1", *command_line.IN_RUN)
        (folder / "printed.txt").write_text(done.stdout)

    return made_once(tmp_path_factory, "main_job", work)


@pytest.fixture(scope="module")
def home(main_job: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to work in, with the outcome of one small main job in `run`."""
    return Path(shutil.copytree(main_job, tmp_path_factory.mktemp("home") / "home"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small store of the toy world."""
    import toy

    return Path(toy.make_store(tmp_path_factory.mktemp("episodes")).folder)


@pytest.fixture
def make_world() -> Iterator[Callable[..., World]]:
    """Makes worlds with a policy node, each on a domain of its own; arguments are the command and those of ROS."""
    from world import World

    worlds: list[World] = []

    def make(command: str = "joint_state", *arguments: str, **options: Any) -> World:
        worlds.append(World(next(domains), command, list(arguments), **options))
        return worlds[-1]

    yield make
    for world in worlds:
        world.close()
