"""Collection on a Dask cluster, of processes on this machine: the same bytes, whatever becomes of its workers."""

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
from socket import create_server
from threading import Thread

import pytest
import toy
from distributed import Client
from test_collect import EPISODES, TRIED, content, lines
from test_run import SMALL, vla

from vla.cluster import Cluster, Dask, Local
from vla.collect import MakeEnvironment, collect
from vla.data.episodes import EpisodeStore

HERE = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")
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


@contextmanager
def scheduler(folder: Path, **environment: str) -> Iterator[tuple[str, Process]]:
    """The address of a scheduler, and its process."""
    file = folder / "scheduler.json"
    environment["DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"] = "1s"  # to fetch a result from a worker that just died
    with dask("scheduler", *HERE, "--port", "0", "--scheduler-file", str(file), **environment) as process:
        yield address_in(file), process


def address_in(file: Path) -> str:
    """The address that a scheduler is about to write to a file."""
    until(lambda: file.exists() and file.read_text().rstrip().endswith("}"))
    address: str = json.loads(file.read_text())["address"]
    return address


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a scheduler listens."""
    with scheduler(tmp_path_factory.mktemp("scheduler")) as (address, _):
        yield address


@contextmanager
def worker(address: str, *arguments: str) -> Iterator[Process]:
    """A worker that has joined the scheduler."""
    with Client(address) as client, dask("worker", address, *HERE, "--nthreads", "1", *arguments) as process:
        before = client.nthreads()
        until(lambda: len(client.nthreads()) > len(before))
        yield process


def gather(folder: Path, cluster: Cluster, make_environment: MakeEnvironment = toy.make_environment) -> None:
    store = EpisodeStore.create_or_open(folder, toy.SPEC, {})
    collect(store, make_environment, toy.make_expert, EPISODES, cluster, seed=0)


def until(condition: Callable[[], bool]) -> None:
    give_up = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.01)


@contextmanager
def killed(process: Process, folder: Path) -> Iterator[list[int]]:
    """Within, a process is killed once some seeds are committed in `folder`; the list takes how many there were."""
    committed: list[int] = []

    def kill() -> None:
        until(lambda: lines(folder) >= 3)
        process.kill()
        committed.append(lines(folder))

    thread = Thread(target=kill)
    thread.start()
    yield committed
    thread.join()


def test_killing_one_of_two_workers_changes_no_byte_of_what_is_collected(address: str, tmp_path: Path) -> None:
    arguments = [*SMALL, "job=collect", "task.image_size=[16,16]", "collect.episodes=14"]
    remote = ["cluster=dask", f"cluster.address={address}", "collect.folder=remote"]
    doomed, other = (worker(address, "--no-nanny") for _ in range(2))
    with doomed as process, other, killed(process, tmp_path / "remote") as committed:
        vla(tmp_path, *arguments, *remote)
    assert committed[0] < 14
    vla(tmp_path, *arguments, "collect.folder=local")
    assert content(tmp_path / "remote") == content(tmp_path / "local")


def test_without_workers_it_gives_up_and_goes_on_elsewhere(address: str, tmp_path: Path) -> None:
    folder, whole = tmp_path / "episodes", tmp_path / "whole"
    without = pytest.raises(ValueError, match=r"has had no worker for 0\.5 s: what was committed is safe")
    with worker(address, "--no-nanny") as only, killed(only, folder), without:
        gather(folder, Dask(address, patience=0.5), toy.make_slow_environment)
    assert 3 <= len(EpisodeStore(folder).tried) < TRIED
    gather(folder, Local(1))
    gather(whole, Local(1))
    assert content(folder) == content(whole)


def test_a_seed_that_brings_down_every_worker_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "episodes"
    death = pytest.raises(ValueError, match=r"the workers of tcp://\S+ die")
    with scheduler(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _), worker(address), death:
        gather(folder, Dask(address), toy.make_deadly_environment)
    assert [entry.seed for entry in EpisodeStore(folder).tried] == list(range(lines(folder)))


def test_a_worker_with_other_versions_is_refused(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla.cluster.LIBRARIES", ("numpy",))
    other = pytest.raises(ValueError, match=r" has .*'mujoco'.*: install the same versions everywhere")
    with worker(address, "--no-nanny"), other:
        gather(tmp_path / "episodes", Dask(address))


def test_a_scheduler_that_is_not_there_or_goes_away_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla.cluster.CONNECT", 0.5)
    folder = tmp_path / "episodes"
    silence = pytest.raises(ValueError, match="no Dask scheduler answers")
    with scheduler(tmp_path) as (address, process), worker(address, "--no-nanny"), killed(process, folder), silence:
        gather(folder, Dask(address), toy.make_slow_environment)
    with create_server(("127.0.0.1", 0)) as mute, pytest.raises(ValueError, match="no Dask scheduler answers"):
        gather(folder, Dask(f"tcp://127.0.0.1:{mute.getsockname()[1]}"))
    with pytest.raises(ValueError, match=r"must read tcp://HOST:PORT, got '8786'"):
        Dask("8786")


def test_what_a_scheduler_lacks_is_named(tmp_path: Path) -> None:
    lack = pytest.raises(ValueError, match=r"lacks something \(No module named 'toy'\): install vla\[cluster\] there")
    with scheduler(tmp_path, PYTHONPATH="") as (address, _), lack:
        gather(tmp_path / "episodes", Dask(address))


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"install vla\[cluster\]"):
        Dask("tcp://127.0.0.1:8786")
