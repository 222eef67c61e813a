"""An evaluation that is interrupted, or whose disk is full, continues with the episodes that it has played."""

from __future__ import annotations

import json
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import toy_recordable as toy
from command_line import here

from vla.io.documents import MAX_BYTES
from vla.parallel.pool import Cluster
from vla.rollouts.evaluate import evaluate
from vla.rollouts.results import Report, Result
from vla.runs.played import PLAYED, Played
from vla.spec import FIRST_SEED, Array, Observation
from vla.tasks.perturb import Perturbed

SEEDS = range(FIRST_SEED, FIRST_SEED + 6)
EPISODES = 4
COMMAND = (
    "agent=expert",
    "task.time_limit=2",
    "recorder=none",
    f"evaluate.episodes={EPISODES}",
    "+evaluate.conditions.short.time_limit=1",
    "cluster.workers=1",
)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """What a full disk looks like to this process: no file can grow beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def reported(folder: Path) -> dict[str, Any]:
    """The report, without what differs between two evaluations of the same."""
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    del report["wall_time_s"], report["config"]["output"]
    return report


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("whole")
    here(folder, *COMMAND, "output=run")
    assert not (folder / "run" / PLAYED).exists()
    return reported(folder / "run")


@pytest.fixture(scope="module")
def played_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("played")
    with pytest.MonkeyPatch.context() as patch:

        def full(*arguments: object, **named: object) -> None:
            raise OSError(28, "No space left on device")

        patch.setattr("vla.jobs.evaluate.write_report", full)
        failed = here(folder, *COMMAND, "output=run", ok=False)
    assert "report.json cannot be written (No space left on device): make room there" in failed.stderr
    assert f"/{EPISODES} (" in failed.stdout and not (folder / "run/report.json").exists()
    return folder


@pytest.fixture
def played(played_once: Path, tmp_path: Path) -> Path:
    """A folder with all episodes of an evaluation, whose report found no room."""
    return shutil.copytree(played_once, tmp_path, dirs_exist_ok=True)


def test_a_report_without_room_costs_no_episode(played: Path, whole: dict[str, Any]) -> None:
    done = here(played, *COMMAND, "output=run")
    assert f"already played, {2 * EPISODES} in all" in done.stdout + done.stderr
    assert reported(played / "run") == whole
    assert not (played / "run" / PLAYED).exists()


def test_a_disk_that_fills_up_costs_only_the_episode_that_found_no_room(played: Path, whole: dict[str, Any]) -> None:
    lines = (played / "run" / PLAYED).read_bytes().splitlines(keepends=True)
    (played / "run" / PLAYED).unlink()
    with files_of_at_most(sum(map(len, lines[: 1 + EPISODES + 2])) + 100):
        failed = here(played, *COMMAND, "output=run", ok=False)
    assert f"{PLAYED} cannot be written (File too large)" in failed.stderr
    assert f"keeps what was played, {EPISODES + 2} in all" in failed.stdout + failed.stderr
    done = here(played, *COMMAND, "output=run")
    assert f"already played, {EPISODES + 2} in all" in done.stdout + done.stderr
    assert reported(played / "run") == whole


def test_only_episodes_that_ended_in_an_error_are_played_again(tmp_path: Path, whole: dict[str, Any]) -> None:
    act = Perturbed.act

    def act_once(self: Perturbed, observation: Observation) -> Array:
        if not (tmp_path / "failed").exists():
            (tmp_path / "failed").touch()
            raise RuntimeError("a cable is loose")
        return act(self, observation)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Perturbed, "act", act_once)
        failed = here(tmp_path, *COMMAND, "output=run", ok=False)
    assert "1 episodes ended in an error, see run/report.json" in failed.stderr
    done = here(tmp_path, *COMMAND, "output=run")
    assert f"already played, {2 * EPISODES - 1} in all" in done.stdout + done.stderr
    assert reported(tmp_path / "run") == whole


@pytest.mark.parametrize("change", ["evaluate.seed=1000001", "task.time_limit=3"])
def test_episodes_of_another_evaluation_are_not_used(played: Path, change: str) -> None:
    done = here(played, *COMMAND, change, "output=run")
    assert "is of another evaluation" in done.stdout + done.stderr
    assert "already played" not in done.stdout + done.stderr


def test_a_line_that_a_killed_process_left_unfinished_is_played_again(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), Played(tmp_path, [], {}, {}) as first:
        for seed in SEEDS:
            first.add("seen", Result(seed, "success"))
        raise KeyboardInterrupt
    file = tmp_path / PLAYED
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(KeyboardInterrupt), Played(tmp_path, [], {}, {}) as again:
        assert list(again.of("seen")) == list(SEEDS[:-1])
        again.add("seen", Result(SEEDS[-1], "dropped"))
        raise KeyboardInterrupt
    with Played(tmp_path, [], {}, {}) as last:
        assert last.of("seen")[SEEDS[-1]].outcome == "dropped" and len(last) == len(SEEDS)
    assert not file.exists()


def test_an_evaluation_of_any_length_goes_on(tmp_path: Path) -> None:
    long = Result(FIRST_SEED, "success", "x" * (1 << 20))
    with pytest.raises(KeyboardInterrupt), Played(tmp_path, [], {}, {}) as first:
        for number in range(70):
            first.add(f"condition_{number}", long)
        raise KeyboardInterrupt
    assert (tmp_path / PLAYED).stat().st_size > MAX_BYTES
    with Played(tmp_path, [], {}, {}) as again:
        assert len(again) == 70


def test_weights_that_changed_since_start_anew(tmp_path: Path) -> None:
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"weights")
    for expected in (0, 1):
        with pytest.raises(KeyboardInterrupt), Played(tmp_path, [checkpoint], {}, {}) as played:
            assert len(played) == expected
            played.add("seen", Result(FIRST_SEED, "success"))
            raise KeyboardInterrupt
    for versions in ({"mujoco": "3.3.0"}, {}):
        with pytest.raises(KeyboardInterrupt), Played(tmp_path, [checkpoint], {}, versions) as played:
            assert len(played) == 0
            played.add("seen", Result(FIRST_SEED, "success"))
            raise KeyboardInterrupt
    checkpoint.touch()
    with Played(tmp_path, [checkpoint], {}, {}) as played:
        assert len(played) == 0


def test_a_policy_in_a_folder_that_changed_since_starts_anew(tmp_path: Path) -> None:
    weights = tmp_path / "model/shards/weights.safetensors"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(b"weights")
    for expected in (0, 1):
        with pytest.raises(KeyboardInterrupt), Played(tmp_path, [tmp_path / "model"], {}, {}) as played:
            assert len(played) == expected
            played.add("seen", Result(FIRST_SEED, "success"))
            raise KeyboardInterrupt
    weights.touch()
    with Played(tmp_path, [tmp_path / "model"], {}, {}) as played:
        assert len(played) == 0


@pytest.mark.parametrize("workers", [1, 2])
def test_known_episodes_are_not_played_again(workers: int) -> None:
    expected = evaluate(toy.make_environment, toy.make_agent, None, SEEDS)
    known = {result.seed: result for result in expected.results[::2]}
    kept = list[Result]()
    report = evaluate(
        *(toy.make_environment, toy.make_agent, None, SEEDS, Cluster(workers, "beside")),
        known=known,
        keep=kept.append,
    )
    assert report == expected and {result.seed for result in kept} == {*SEEDS} - {*known}


def test_a_decision_that_known_episodes_suffice_for_plays_none() -> None:
    known = {seed: Result(seed, "success") for seed in SEEDS}
    kept = list[Result]()

    def two(report: Report) -> bool:
        return report.episodes == 2

    report = evaluate(
        toy.make_environment,
        toy.make_agent,
        None,
        range(FIRST_SEED, FIRST_SEED + 99),
        until=two,
        known=known,
        keep=kept.append,
    )
    assert [result.seed for result in report.results] == list(SEEDS[:2]) and not kept
