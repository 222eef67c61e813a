"""Collection: the same bytes whatever the workers and whatever interrupts them."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import toy
from collecting import EPISODES, TRIED, content, lines
from composing import composed
from test_libero import PLAIN
from toy_episodes import full_disk

from vla.config.experiment import Experiment
from vla.data.episodes import EpisodeStore
from vla.data.index import NOT_NEEDED
from vla.data.verification import verify_store
from vla.parallel.pool import Cluster
from vla.rollouts.collect import MAX_FAILURES, NOT_REPEATABLE, DemonstrationWorker, Summary, collect
from vla.rollouts.rollout import AgentFactory, EnvironmentFactory, rollout
from vla.spec import FIRST_SEED, Episode, Multitask, Observation

SCRIPT = """
import sys, toy
from vla.parallel.pool import Cluster
from vla.rollouts.collect import collect
from vla.data.episodes import EpisodeStore

store = EpisodeStore.create_or_open(sys.argv[1], toy.SPEC, {})
workers, episodes = int(sys.argv[2]), int(sys.argv[3])
collect(store, toy.make_slow_environment, toy.make_expert, episodes, Cluster(workers, "beside"), seed=0)
"""


def gather(
    folder: Path,
    episodes: int = EPISODES,
    workers: int = 1,
    make_environment: EnvironmentFactory = toy.make_environment,
    make_expert: AgentFactory = toy.make_expert,
    multitask: Multitask | None = None,
) -> Summary:
    store = EpisodeStore.create_or_open(folder, toy.SPEC, {})
    return collect(store, make_environment, make_expert, episodes, Cluster(workers, "beside"), 0, multitask)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an uninterrupted collection by one process leaves."""
    folder = tmp_path_factory.mktemp("whole")
    gather(folder)
    return folder


@pytest.fixture(scope="module")
def larger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of twice as many episodes."""
    folder = tmp_path_factory.mktemp("larger")
    gather(folder, episodes=2 * EPISODES)
    return folder


def start(folder: Path, until: int, workers: int = 2, episodes: int = EPISODES) -> subprocess.Popen[str]:
    """A process that is collecting, and has committed `until` seeds."""
    places = [str(Path(toy.__file__).parent), str(Path(toy.__file__).parents[1])]
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder), str(workers), str(episodes)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(places)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    while lines(folder) < until:
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.002)
    return process


def test_two_workers_leave_the_same_bytes_as_one(tmp_path: Path, whole: Path) -> None:
    summary, store = gather(tmp_path, workers=2), EpisodeStore(tmp_path)
    assert content(tmp_path) == content(whole)
    assert (summary.episodes, summary.added, summary.attempts) == (EPISODES, EPISODES, TRIED)
    assert summary.failures == {"timeout": TRIED - EPISODES} and summary.success_rate == EPISODES / TRIED
    assert [entry.seed for entry in store.attempts] == list(range(TRIED))
    assert all(entry.seed % 5 != 3 for entry in store.episodes)


def test_a_larger_count_adds_only_what_is_missing(tmp_path: Path, whole: Path) -> None:
    gather(tmp_path, episodes=11)
    assert gather(tmp_path).added == EPISODES - 11
    assert content(tmp_path) == content(whole)
    assert gather(tmp_path, episodes=5).added == 0
    assert content(tmp_path) == content(whole)
    for episodes in (1, 60):
        store = EpisodeStore(tmp_path)
        with pytest.raises(ValueError, match=r"starts at seed 0, not 7: set collect\.seed=0"):
            collect(store, toy.make_environment, toy.make_expert, episodes, Cluster(1, "beside"), seed=7)


def in_turn(folder: Path, episodes: int, workers: int = 1) -> Summary:
    return gather(folder, episodes, workers, toy.make_in_turn, multitask=toy.make_in_turn())


def test_tasks_that_the_seed_tells_get_equal_shares_at_any_time(tmp_path: Path) -> None:
    summary = in_turn(tmp_path, 24)
    store = EpisodeStore(tmp_path)
    for rounds in range(1, 9):
        assert Counter(entry.task for entry in store.episodes[: 3 * rounds]) == dict.fromkeys("abc", rounds)
    assert [entry.seed for entry in store.attempts] == list(range(len(store.attempts)))
    passed = [entry.task for entry in store.attempts if entry.outcome == NOT_NEEDED]
    assert passed and "b" not in passed
    # Of seeds that were passed over, nothing is known: neither the expert's success nor its failures count them.
    assert summary.attempts == len(store.attempts) - len(passed) and {*summary.failures} == {"timeout"}
    assert summary.tasks["a"][0] == summary.tasks["b"][0] == 8 < summary.tasks["b"][1]
    assert verify_store(store).success_rate == summary.success_rate == 24 / summary.attempts


def test_shares_depend_neither_on_workers_nor_on_interruptions(tmp_path: Path) -> None:
    in_turn(tmp_path / "whole", 20)
    in_turn(tmp_path / "parallel", 20, workers=2)
    for episodes in (2, 7, 20):
        in_turn(tmp_path / "grown", episodes)
    assert content(tmp_path / "parallel") == content(tmp_path / "grown") == content(tmp_path / "whole")


def test_killed_at_random_moments_it_loses_and_doubles_nothing(tmp_path: Path, larger: Path) -> None:
    folder, random = tmp_path / "episodes", np.random.default_rng(0)
    for kill in range(5):
        before = lines(folder)
        # Every other one while it starts, or just after, the rest between two commits or within one.
        process = start(folder, before + kill % 2, workers=2 if kill < 2 else 1, episodes=2 * EPISODES)
        time.sleep(random.uniform(0, 0.05 if kill % 2 else 0.8))
        process.kill()
        process.communicate(timeout=20)  # its workers hold the same pipe: this ends when they are gone too
        assert before + kill % 2 <= lines(folder)
        if (folder / "store.json").exists():
            store = EpisodeStore(folder)
            assert [entry.seed for entry in store.attempts] == list(range(len(store.attempts)))
            assert all(store.read(entry)["action"].shape[0] == entry.steps for entry in store.episodes)
    gather(folder, episodes=2 * EPISODES)
    assert content(folder) == content(larger)


@pytest.mark.parametrize("pause", [None, 0.0, 0.3])
def test_ctrl_c_ends_it_with_one_traceback_and_twice_too(tmp_path: Path, larger: Path, pause: float | None) -> None:
    folder = tmp_path / "episodes"
    process = start(folder, 3, episodes=10 * EPISODES)
    os.killpg(process.pid, signal.SIGINT)
    if pause is not None:
        time.sleep(pause)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
    output = process.communicate(timeout=20)[0]  # its workers hold the same pipe
    if pause is None:
        # Where it arrives while another exception is handled, that one's comes first.
        assert output.count("Traceback") - output.count("During handling of the above exception") == 1
        assert output.count("\nKeyboardInterrupt") == 1 and output.rstrip().endswith("KeyboardInterrupt")
    gather(folder, episodes=2 * EPISODES)
    assert content(folder) == content(larger)


def test_a_second_job_waits_for_the_first_and_uses_its_episodes(
    tmp_path: Path, whole: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "episodes"
    process = start(folder, 1, workers=1)
    with caplog.at_level(logging.INFO, "vla"):
        assert gather(folder).added == 0
    assert "waiting for the process that is collecting" in caplog.text
    assert process.wait(timeout=20) == 0
    assert content(folder) == content(whole)


def test_a_worker_that_dies_is_reported_and_costs_nothing(tmp_path: Path, whole: Path) -> None:
    with pytest.raises(ValueError, match=r"a worker process crashed twice: it ended with exit status 1; .* safe"):
        gather(tmp_path, workers=2, make_environment=toy.make_deadly_environment)
    assert [entry.seed for entry in EpisodeStore(tmp_path).attempts] == list(range(lines(tmp_path)))
    gather(tmp_path)
    assert content(tmp_path) == content(whole)


def test_demonstrations_never_come_from_the_seeds_of_evaluations(tmp_path: Path) -> None:
    store = EpisodeStore.create_or_open(tmp_path, toy.SPEC, {})
    with pytest.raises(ValueError, match="seeds from 1000000 on are reserved for evaluation"):  # one fails
        collect(store, toy.make_environment, toy.make_expert, 4, Cluster(1, "beside"), FIRST_SEED - 4)
    assert store.episodes and all(entry.seed < FIRST_SEED for entry in store.attempts)


def test_an_expert_without_hope_is_given_up(tmp_path: Path) -> None:
    words = rf"failed on {MAX_FAILURES} seeds of (red|blue) in a row \({{'timeout': {MAX_FAILURES}}}\)"
    with pytest.raises(ValueError, match=words):
        gather(tmp_path, make_expert=toy.make_lost_expert)
    assert EpisodeStore(tmp_path).episodes == []
    with pytest.raises(ValueError, match=NOT_REPEATABLE):  # a success that cannot be replayed is a failure
        gather(tmp_path / "forgetful", make_environment=toy.make_forgetful_environment)
    assert EpisodeStore(tmp_path / "forgetful").episodes == []


def test_an_expert_that_does_not_look_leaves_the_same_demonstrations_from_fewer_images() -> None:
    class Counting(toy.ToyEnvironment):
        drawn = 0

        def _look(self) -> Observation:
            self.drawn += not self._blind
            return super()._look()

    class Seeing(toy.ToyExpert):
        looks = True

    environments = Counting(), Counting()
    blind = DemonstrationWorker(lambda: environments[0], lambda _: toy.ToyExpert())
    seeing = DemonstrationWorker(lambda: environments[1], lambda _: Seeing())
    for seed in (1, 3):  # a success and a failure
        one, other = blind.attempt(seed), seeing.attempt(seed)
        assert one.outcome == other.outcome and np.array_equal(one.actions, other.actions)
        assert same_images(one, other)
        counts = [environment.drawn for environment in environments]
    steps = len(blind.attempt(1).observations)
    assert counts == [1 + steps + 1 + 1, steps + 1 + 41]  # every reset draws one image


@pytest.mark.parametrize(
    "world",
    [
        ("task/randomize=wide",),
        ("task=metaworld", "task.tasks=[push]", "task.window=[0.2,0,0.8,0.8]"),
        (*PLAIN, "task.suite=goal", "task.tasks=[7]", "expert.perturb.noise=0", "expert.perturb.missed=0"),
    ],
    ids=" ".join,
)
def test_images_drawn_in_the_replay_are_those_of_the_rollout(world: tuple[str, ...]) -> None:
    experiment = Experiment.from_config(composed(*world, "task.image_size=[48,64]"))
    worker = DemonstrationWorker(experiment.make_environment(), experiment.make_expert())
    seed, episode = next((seed, found) for seed in range(20) if (found := worker.attempt(seed)).success)
    environment = experiment.make_environment()()
    assert same_images(episode, rollout(environment, experiment.make_expert()(environment), seed))
    environment.close()
    worker.close()


def same_images(one: Episode, other: Episode) -> bool:
    """Whether the episodes have the same images, all of them."""
    return all(
        a.rgb.keys() == b.rgb.keys() and a.rgb and all(np.array_equal(a.rgb[name], b.rgb[name]) for name in a.rgb)
        for a, b in zip(one.observations, other.observations, strict=True)
    )


def test_a_disk_that_fills_up_costs_nothing_that_was_committed(tmp_path: Path, whole: Path) -> None:
    safe = r"cannot take seed \d+ \(.*\): make room and run again to continue after \d+ safe episodes"
    with full_disk((whole / "rgb_eye.bin").stat().st_size // 2), pytest.raises(ValueError, match=safe):
        gather(tmp_path)
    assert len(EpisodeStore(tmp_path).episodes) > 5
    gather(tmp_path)
    assert content(tmp_path) == content(whole)
