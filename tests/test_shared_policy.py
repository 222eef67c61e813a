"""One policy for the worlds of all worker processes: the same episodes as beside each of them, bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from errno import ENOSPC
from functools import partial
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from threading import Event
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_batch import as_policy, make_act, make_bc, make_denoising, make_rt1
from toy import SPEC, Telling, ToyEnvironment

from vla.io.errors import UserError
from vla.models.flow import Flow
from vla.models.model import Model
from vla.parallel.pool import Cluster
from vla.rollouts.evaluate import evaluate
from vla.rollouts.rollout import rollout
from vla.rollouts.shared_policy import _accept, shared_policy
from vla.rollouts.supervised import SupervisedAgent
from vla.spec import FIRST_SEED, Agent, Environment, Observation

MODELS: dict[str, Callable[[], Model]] = {
    "bc": partial(make_bc, chunk=2),
    "rt1": make_rt1,
    "act": partial(make_act, execute=2),
    "flow": partial(make_denoising, Flow),
}
SEEDS = range(FIRST_SEED, FIRST_SEED + 6)


@pytest.mark.parametrize(("name", "numbers"), [("bc", (1, 2, 4)), ("rt1", (4,)), ("act", (4,)), ("flow", (4,))])
def test_reports_are_the_same_with_any_number_of_workers(name: str, numbers: tuple[int, ...]) -> None:
    policy = as_policy(MODELS[name](), lanes=2)
    beside = evaluate(Telling, lambda world: policy, None, SEEDS)
    with shared_policy(lambda: policy) as agent:
        reports = [evaluate(Telling, agent, None, SEEDS, Cluster(workers, "beside")) for workers in numbers]
    assert not beside.errors and reports == [beside] * len(numbers)


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())
def test_an_episode_is_that_of_the_policy_alone_and_so_are_chunks_and_probabilities(make: Callable[[], Model]) -> None:
    policy = as_policy(make(), lanes=4)
    expected = rollout(Telling(), policy, 3).executed
    seen, known = Telling().reset(3), policy.info
    policy.reset(seen.instruction, 3)
    planned = policy.plan(seen)
    with shared_policy(lambda: policy) as make_agent, closing(make_agent(Telling())) as agent:
        np.testing.assert_array_equal(rollout(Telling(), agent, 3).executed, expected)
        np.testing.assert_equal(agent.info, known)
        agent.reset(seen.instruction, 3)
        np.testing.assert_array_equal(agent.plan(seen), planned)


def test_a_world_with_sharper_cameras_has_its_images_resized_by_the_policy() -> None:
    policy = as_policy(make_bc())
    sharp = replace(SPEC, image_size=(20, 32))
    seen = sharp.random_observation(np.random.default_rng(0))
    policy.reset(seen.instruction, 0)
    expected = policy.act([seen], [0])
    with shared_policy(lambda: policy) as make_agent, closing(make_agent(ToyEnvironment(spec=sharp))) as agent:
        agent.reset(seen.instruction, 0)
        np.testing.assert_array_equal(agent.act(seen), expected[0])


def watch_memory(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the shared memory that is made from now on."""
    used: list[str] = []

    def made(*arguments: Any, **options: Any) -> SharedMemory:
        memory = SharedMemory(*arguments, **options)
        used.append(memory.name)
        return memory

    monkeypatch.setattr("vla.rollouts.shared_policy.SharedMemory", made)
    return used


def require_gone(names: list[str]) -> None:
    assert names
    for name in names:
        with pytest.raises(FileNotFoundError):
            SharedMemory(name)


def test_what_does_not_fit_is_said_and_no_memory_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    used = watch_memory(monkeypatch)
    with shared_policy(lambda: as_policy(make_bc())) as make_agent:
        with pytest.raises(ValueError, match=r"the policy has cameras = \('eye',\), but the task has"):
            make_agent(ToyEnvironment(spec=SPEC.from_dict({**SPEC.to_dict(), "cameras": ["ear"]})))
        with closing(make_agent(ToyEnvironment())) as agent:
            seen = SPEC.random_observation(np.random.default_rng(0))
            with pytest.raises(
                ValueError, match=r"the world gives eye of \(8, 16, 3\) uint8, but its spec says \(16, 16, 3\) uint8"
            ):
                agent.act(Observation({"eye": seen.rgb["eye"][:8]}, seen.state, "go"))
            with pytest.raises(ValueError, match=r"the policy needs "):
                agent.act(Observation({}, seen.state, "go"))
            with pytest.raises(ValueError, match="an instruction has at most 1000 characters"):
                agent.reset("a" * 1001, 0)
            assert agent.act(seen).shape == (3,)
    require_gone(used)


def test_a_failure_while_a_worker_begins_ends_the_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = as_policy(make_bc())

    def no_space(*arguments: Any, **options: Any) -> Any:
        raise OSError(ENOSPC, "No space left on device")

    def on_new_expert(world: Environment) -> Agent:
        raise UserError("no expert")

    with pytest.raises(OSError, match="No space left"), shared_policy(lambda: policy) as make_agent:
        evaluate(Telling, make_agent, no_space, SEEDS)
    with pytest.raises(UserError, match="no expert"), shared_policy(lambda: policy) as make_agent:
        evaluate(Telling, partial(SupervisedAgent, make_agent, on_new_expert), None, SEEDS)
    used = watch_memory(monkeypatch)
    monkeypatch.setattr(os, "posix_fallocate", no_space)
    with (
        pytest.raises(UserError, match=r"no 0\.0 MB of shared mem"),
        shared_policy(lambda: policy) as make_agent,
    ):
        evaluate(Telling, make_agent, None, SEEDS)
    require_gone(used)
    monkeypatch.setattr("vla.rollouts.shared_policy.SharedMemory", no_space)
    with pytest.raises(OSError, match="No space left"), shared_policy(lambda: policy) as make_agent:
        evaluate(Telling, make_agent, None, SEEDS)


def test_a_worker_is_answered_until_it_has_left_also_when_the_context_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, seen, ending = as_policy(make_bc()), SPEC.random_observation(np.random.default_rng(0)), Event()

    def accept(*arguments: Any) -> None:
        _accept(*arguments)
        ending.set()

    def late(agent: Any) -> Any:
        with closing(agent):
            assert ending.wait(60)
            agent.reset(seen.instruction, 0)
            return agent.act(seen)

    monkeypatch.setattr("vla.rollouts.shared_policy._accept", accept)
    with ThreadPoolExecutor(1) as worker:
        with shared_policy(lambda: policy) as make_agent:
            action = worker.submit(late, make_agent(ToyEnvironment()))
        assert action.result().shape == (3,)


def test_the_folder_for_temporary_files_may_have_a_long_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder := tmp_path / ("batch_job_" * 20)).mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    policy, seen = as_policy(make_bc()), SPEC.random_observation(np.random.default_rng(0))
    with shared_policy(lambda: policy) as make_agent, closing(make_agent(ToyEnvironment())) as agent:
        agent.reset(seen.instruction, 0)
        assert agent.act(seen).shape == (3,)


def test_a_worker_is_told_of_every_error_of_the_policy() -> None:
    class Odd(Exception): ...  # which cannot be sent

    policy: Any = as_policy(make_bc())
    policy.act = Mock(side_effect=[Odd("no idea"), []])
    observation = SPEC.random_observation(np.random.default_rng(0))
    with shared_policy(lambda: policy) as make_agent, closing(make_agent(ToyEnvironment())) as agent:
        for words in ("Odd: no idea", "the policy gave 0 answers to 1 request"):
            with pytest.raises(RuntimeError, match=words):
                agent.act(observation)


def test_the_lane_of_a_worker_that_has_left_is_the_next_ones() -> None:
    lanes, talks = list[int](), list[Future[None]]()

    def begin(lane: int, connection: Any, spec: Any) -> Future[None]:
        lanes.append(lane)
        talks.append(Future())
        if len(talks) == 2:
            talks[0].set_result(None)
        return talks[-1]

    listener = Mock()
    listener.accept().recv.side_effect = [SPEC] * 4 + [None]
    _accept(listener, begin)
    assert lanes == [0, 1, 0, 2]
