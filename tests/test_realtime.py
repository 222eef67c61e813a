"""Chunks that arrive late: which action acts at which step, over simulated networks and in real time."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import toy
from fake_batch import as_policy, make_act

from vla.rollouts.evaluate import evaluate
from vla.rollouts.realtime import (
    BackgroundLink,
    Network,
    NetworkedAgent,
    RealTime,
    SimulatedLink,
    weighted_mean,
)
from vla.rollouts.rollout import rollout
from vla.schedule import Schedule
from vla.spec import FIRST_SEED, Array, Observation

# A plain arm: one component that moves it, an absolute position, which is also in the state, and a gripper.
SPEC = replace(toy.SPEC, action=("move", "east", "gripper"), low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0))
SEEN = SPEC.random_observation(np.random.default_rng(0))


def network_of(latency: float, jitter: float = 0.0, loss: float = 0.0, ensemble: float | None = None) -> Network:
    """A network, by default of no delay but the latency."""
    return Network(latency, jitter, loss, ensemble)


class Counting:
    """Plans chunks of `chunk` actions, whose components are the number of the call + the place in the chunk / 100."""

    def __init__(self, chunk: int, execute: int, seconds: float = 0.0) -> None:
        self.info: dict[str, Any] = {}
        self.execute, self._chunk, self._seconds = execute, chunk, seconds
        self.calls = 0

    def reset(self, instruction: str, seed: int) -> None:
        self.calls = 0

    def act(self, observation: Observation) -> Array:
        """Not called by those who plan."""
        raise NotImplementedError

    def plan(self, observation: Observation) -> Array:
        """The next chunk; all but the first one take some time."""
        time.sleep(self._seconds if self.calls else 0)
        self.calls += 1
        return (self.calls + np.arange(self._chunk)[:, None] / 100 + np.zeros(3)).astype(np.float32)


def moves(actions: list[Array]) -> list[float]:
    """The first components of actions, of which the others are held where it is zero."""
    assert all(action.shape == (3,) and action.dtype == np.float32 for action in actions)
    assert all(np.all(action[1:] == (action[0] or action[1])) and action[1] for action in actions)  # held, not zero
    return [round(float(action[0]), 2) for action in actions]


def acted(network: Network, chunk: int, execute: int, steps: int, seed: int = 0) -> list[float]:
    agent = NetworkedAgent(lambda _: Counting(chunk, execute), network, toy.ToyEnvironment(spec=SPEC))
    agent.reset("", seed)
    return moves([agent.act(SEEN) for _ in range(steps)])


def test_a_schedule_tells_whose_action_is_due() -> None:
    schedule = Schedule[str](0.5)
    assert schedule.wants_plan(7.0, 1) and schedule.actions_at(7.0) == [] and schedule.end == -np.inf
    schedule.add("abc", 1.0)
    schedule.add("ABC", 2.0)  # of an observation at 2.0, whenever it arrives
    due = {at: schedule.actions_at(at) for at in (0.0, 1.0, 1.49, 1.5, 2.0, 2.5, 3.49, 3.5)}
    assert due == {**{0.0: ["a", "A"], 1.0: ["a", "A"], 1.49: ["a", "A"]}, **{1.5: ["b", "A"], 2.0: ["c", "A"]}} | {
        2.5: ["B"],
        3.49: ["C"],
        3.5: [],
    }
    assert schedule.end == 3.5 and not schedule.wants_plan(2.9, 2) and schedule.wants_plan(3.0, 2)


@pytest.mark.parametrize(
    ("network", "chunk", "execute", "expected"),
    [
        (network_of(0.0), 4, 2, [1.00, 1.01, 2.00, 2.01, 3.00]),
        # 10 Hz: the second observation, at step 2, is answered at step 4, of which two actions are past by then.
        (network_of(0.2), 5, 2, [1.00, 1.01, 1.02, 1.03, 2.02, 2.03, 3.02]),
        # An answer between steps is for the later one.
        (network_of(0.11), 5, 2, [1.00, 1.01, 1.02, 1.03, 2.02, 2.03, 3.02]),
        # An arm without actions holds, and its plan does not age.
        (network_of(0.2), 1, 1, [1.00, 0, 0, 2.00, 0, 0, 3.00]),
        # Asked at step 2, out of actions at step 3 with one executed in between, answered at step 5.
        (network_of(0.3), 3, 2, [1.00, 1.01, 1.02, 0, 0, 2.01, 2.02]),
        # A chunk a step: of the third step there are three.
        (network_of(0.0, ensemble=0.0), 3, 3, [1.00, 1.5, 2.01]),
    ],
)
def test_a_chunk_goes_on_until_the_next_arrives_which_skips_what_is_past(
    network: Network, chunk: int, execute: int, expected: list[float]
) -> None:
    assert acted(network, chunk, execute, len(expected)) == expected


def test_jitter_and_loss_are_drawn_from_the_seed() -> None:
    for network in (network_of(0.0, jitter=0.5), network_of(0.1, loss=0.5)):
        once, again, other = (acted(network, 4, 2, 40, seed) for seed in (1, 1, 2))
        assert once == again != other
    every, some = acted(network_of(0.1), 1, 1, 40), acted(network_of(0.1, loss=0.5), 1, 1, 40)
    assert max(every) == np.count_nonzero(every) == 20.0
    assert np.count_nonzero(some) < max(some) <= 40.0  # calls of which nothing was heard again


def test_chunks_for_the_same_step_are_averaged_with_the_oldest_first() -> None:
    weights = np.exp([0.0, -0.5])
    mean = weighted_mean([np.full(1, 1.0), np.full(1, 2.0)], 0.5)
    assert mean == pytest.approx((weights[0] * 1 + weights[1] * 2) / weights.sum()) and mean.dtype == np.float32


def test_an_evaluation_without_latency_is_that_of_the_policy_and_with_latency_repeatable() -> None:
    model, environment = make_act(chunk=4, execute=2), toy.make_environment()

    def executed(network: Network) -> Array:
        agent = NetworkedAgent(lambda _: as_policy(model), network, environment)
        return rollout(environment, agent, FIRST_SEED).executed

    expected = rollout(environment, as_policy(model), FIRST_SEED).executed
    np.testing.assert_array_equal(executed(network_of(0.0)), expected)
    late = executed(network_of(0.2, 0.1, 0.1))
    agent = NetworkedAgent(lambda _: as_policy(model), network_of(0.2, 0.1, 0.1), environment)
    partly = rollout(environment, agent, FIRST_SEED, all_images=False)
    np.testing.assert_array_equal(partly.executed, late)
    assert 0 < sum(bool(seen.rgb) for seen in partly.observations) < len(partly.observations)
    np.testing.assert_array_equal(late, executed(network_of(0.2, 0.1, 0.1)))
    assert not np.array_equal(late, expected)


def test_by_the_clock_a_chunk_goes_on_while_the_next_one_is_under_way() -> None:
    """Once the chunk is over, the arm holds: see test_server."""
    agent = Counting(40, 2, seconds=0.1)
    with closing(BackgroundLink(agent.plan, 100.0)) as link:
        acting = RealTime(SPEC, link, lambda: 2, None)
        found = moves([acting.act(SEEN) for _ in range(60)])
    assert found[0] == 1.0 and max(found) > 2 and not np.isin([2.0, 3.0], found).any()  # what is past is skipped


def test_latency_costs_steps_and_then_success() -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + 10)
    at_once, late, later = (
        evaluate(toy.make_environment, partial(NetworkedAgent, toy.make_expert, network_of(latency)), None, seeds)
        for latency in (0.0, 0.1, 0.4)
    )
    assert at_once == evaluate(toy.make_environment, toy.make_expert, None, seeds)
    for one, two in zip(at_once.results, late.results, strict=True):
        assert two.steps == min(2 * one.steps - 1, 40)  # a step of holding after every action
    assert later.success < at_once.success and not later.errors


def test_an_arm_that_waits_stands_still_and_keeps_its_grip() -> None:
    """What carries the load is called otherwise in another world, and has no unit either."""
    spec = replace(SPEC, action=("x", "y", "suction"), low=(-0.05, -0.05, -1.0))
    acting = RealTime(spec, SimulatedLink(lambda _: np.full((1, 3), 0.03), network_of(0.2), 10.0), lambda: 1, None)
    np.testing.assert_allclose([acting.act(SEEN) for _ in range(2)], [[0.03] * 3, [0, 0, 0.03]])


def test_an_agent_with_a_history_sees_every_frame() -> None:
    agent = Counting(3, 3)
    agent.history = 2  # type: ignore[attr-defined]
    distant = NetworkedAgent(lambda _: agent, network_of(0.0), toy.ToyEnvironment(spec=SPEC))
    distant.reset("", 0)
    for _ in range(4):
        distant.act(SEEN)
    assert agent.calls == 4
