"""A Dask cluster of processes on this machine: the same bytes as without it, whatever becomes of its workers."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from socket import create_server
from threading import Thread
from typing import Any

import pytest
import toy
import toy_recordable
from clusters import Process, address_in, dask, until
from collecting import EPISODES, TRIED, content, lines
from command_line import SMALL, here, vla
from defaults import defaults_of
from distributed import Client
from documented import TEXT
from exporting import content as files
from exporting import exporter

from vla.data.episodes import EpisodeStore
from vla.parallel.dask import DaskCluster
from vla.parallel.pool import Cluster, LocalCluster
from vla.rollouts.collect import EnvironmentFactory, collect
from vla.rollouts.evaluate import evaluate
from vla.rollouts.results import Report
from vla.spec import FIRST_SEED

HERE = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")


@contextmanager
def scheduler(folder: Path, **environment: str) -> Iterator[tuple[str, Process]]:
    """The address of a scheduler, and its process."""
    file = folder / "scheduler.json"
    environment["DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"] = "1s"  # to fetch a result from a worker that just died
    with dask("scheduler", *HERE, "--port", "0", "--scheduler-file", str(file), **environment) as process:
        yield address_in(file), process


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a scheduler listens."""
    with scheduler(tmp_path_factory.mktemp("scheduler")) as (address, _):
        yield address


def cluster(address: str, **changes: Any) -> DaskCluster:
    """The workers of a scheduler, as `cluster=dask` describes them."""
    return DaskCluster(**defaults_of("cluster/dask", address=address, **changes))


@contextmanager
def worker(address: str, *arguments: str) -> Iterator[Process]:
    """A worker that has joined the scheduler."""
    with Client(address) as client, dask("worker", address, *HERE, "--nthreads", "1", *arguments) as process:
        before = client.nthreads()
        until(lambda: len(client.nthreads()) > len(before))
        yield process


def gather(folder: Path, cluster: Cluster, make_environment: EnvironmentFactory = toy.make_environment) -> None:
    store = EpisodeStore.create_or_open(folder, toy.SPEC, {})
    collect(store, make_environment, toy.make_expert, EPISODES, cluster, seed=0)


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
    arguments = [*SMALL, "job=collect", "task.image_size=[16,16]", "collect.episodes=32"]
    arguments.remove("cluster.workers=1")
    remote = ["cluster=dask", f"cluster.address={address}", "collect.folder=remote"]
    doomed, other = (worker(address, "--no-nanny") for _ in range(2))
    with doomed as process, other, killed(process, tmp_path / "remote") as committed:
        vla(tmp_path, *arguments, *remote)
    assert committed[0] < 32
    here(tmp_path, *arguments, "cluster.workers=1", "collect.folder=local")
    assert content(tmp_path / "remote") == content(tmp_path / "local")


def test_the_documented_commands_make_a_cluster(tmp_path: Path) -> None:
    """On a free port of this machine, and with one worker."""
    commands = re.findall(r"^dask (.*)$", TEXT, re.MULTILINE)
    on_scheduler, on_worker = (shlex.split(re.sub(r"HOST\b|HERE\b", "127.0.0.1", command)) for command in commands)
    file, whole = tmp_path / "scheduler.json", tmp_path / "whole"
    with dask(*on_scheduler, "--port", "0", "--scheduler-file", str(file)):
        address = address_in(file)
        joined = [address if argument.startswith("tcp:") else argument for argument in on_worker]
        with dask(*(argument.replace("=-1", "=1") for argument in joined)):
            gather(tmp_path / "episodes", cluster(address))
    gather(whole, LocalCluster(1, "beside"))
    assert content(tmp_path / "episodes") == content(whole)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    """A cluster of two workers."""
    with scheduler(tmp_path_factory.mktemp("two")) as (address, _), worker(address, "--nworkers", "2"):
        yield cluster(address)


def test_an_evaluation_reports_and_records_the_same(two: DaskCluster, tmp_path: Path) -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + 6)

    def played(folder: Path, cluster: Cluster) -> tuple[Report, list[str]]:
        folder.mkdir()
        recorder = toy_recordable.make_recorder(folder)
        makers = toy_recordable.make_environment, toy_recordable.make_agent, recorder
        report = evaluate(*makers, seeds, cluster, needs=[folder])
        return report, sorted(path.name for path in folder.iterdir())

    here = played(tmp_path / "here", LocalCluster(1, "beside"))
    assert played(tmp_path / "there", two) == here
    assert len(here[1]) == len(seeds)


@pytest.mark.parametrize("kind", ["files", "lerobot"])
def test_exported_files_are_the_same(kind: str, two: DaskCluster, folder: Path, tmp_path: Path) -> None:
    store = EpisodeStore(folder, 4)
    here = exporter(kind, tmp_path / "here").export(store)
    there = exporter(kind, tmp_path / "there").export(store, two)
    assert files(here) == files(there) != {}


def test_a_file_that_a_worker_does_not_have_is_named(two: DaskCluster, tmp_path: Path) -> None:
    missing = tmp_path / "last.ckpt"
    makers = toy_recordable.make_environment, toy_recordable.make_agent, None
    with pytest.raises(ValueError, match=r" has no .*last\.ckpt: workers need it on a file system that all machines"):
        evaluate(*makers, [FIRST_SEED], two, needs=[missing])


def test_without_workers_it_gives_up_and_goes_on_elsewhere(address: str, tmp_path: Path) -> None:
    folder, whole = tmp_path / "episodes", tmp_path / "whole"
    without = pytest.raises(ValueError, match=r"has had no worker for 0\.5 s: start workers and run again")
    with worker(address, "--no-nanny") as only, killed(only, folder), without:
        gather(folder, cluster(address, patience=0.5), toy.make_slow_environment)
    assert 3 <= len(EpisodeStore(folder).tried) < TRIED
    gather(folder, LocalCluster(1, "beside"))
    gather(whole, LocalCluster(1, "beside"))
    assert content(folder) == content(whole)


def test_a_seed_that_brings_down_every_worker_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "episodes"
    death = pytest.raises(ValueError, match=r"the workers of tcp://\S+ die, .*; committed episodes are safe")
    deadly, seeds = toy_recordable.make_deadly_environment, [toy_recordable.DEADLY_SEED]
    with scheduler(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _), worker(address):
        with death:
            gather(folder, cluster(address), toy.make_deadly_environment)
        report = evaluate(deadly, toy_recordable.make_agent, None, seeds, cluster(address))
    assert "die, perhaps for lack of memory" in report.errors[0].error
    assert [entry.seed for entry in EpisodeStore(folder).tried] == list(range(lines(folder)))


def test_a_worker_with_other_versions_is_refused(
    two: DaskCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vla.parallel.dask.installed_versions", lambda: {"numpy": "1.0", "mujoco": "1.0"})
    # The world of the toy does not load MuJoCo.
    with pytest.raises(ValueError, match=r" has numpy \S+, not 1\.0: install the same versions everywhere"):
        gather(tmp_path / "episodes", two)


def test_a_scheduler_that_is_not_there_or_goes_away_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla.parallel.dask.CONNECT", 0.5)
    folder = tmp_path / "episodes"
    silence = pytest.raises(ValueError, match="no Dask scheduler answers")
    with scheduler(tmp_path) as (address, process), worker(address, "--no-nanny"):
        with killed(process, folder) as committed, silence:
            gather(folder, cluster(address), toy.make_slow_environment)
        assert committed and committed[0] >= 3  # it had been there
    with create_server(("127.0.0.1", 0)) as mute, pytest.raises(ValueError, match="no Dask scheduler answers"):
        gather(folder, cluster(f"tcp://127.0.0.1:{mute.getsockname()[1]}"))
    with pytest.raises(ValueError, match=r"must read tcp://HOST:PORT, got '8786'"):
        cluster("8786")


def test_what_a_scheduler_lacks_is_named(tmp_path: Path) -> None:
    lack = pytest.raises(ValueError, match=r"lacks a package \(No module named 'toy'\): install vla\[cluster\] there")
    with scheduler(tmp_path, PYTHONPATH="") as (address, _), lack:
        gather(tmp_path / "episodes", cluster(address))


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"install vla\[cluster\]"):
        cluster("tcp://127.0.0.1:8786")
