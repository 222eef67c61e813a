"""Chunks that arrive late: which action acts at which step, over simulated networks and a real one."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import toy
from fake_batch import as_policy, make_act

from vla.rollouts.evaluate import evaluate
from vla.rollouts.realtime import Network, OverNetwork, RealTime, Schedule, SimulatedLink, make_over_network
from vla.rollouts.rollout import rollout
from vla.spec import FIRST_SEED, Array, Observation

# A plain arm: one component that moves it, an absolute position, which is also in the state, and a gripper.
SPEC = replace(toy.SPEC, action=("move", "east", "gripper"), low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0))


def network_of(latency: float, jitter: float = 0.0, loss: float = 0.0, ensemble: float | None = None) -> Network:
    """A network, by default of no delay but the latency."""
    return Network(latency, jitter, loss, ensemble)


class Counting:
    """Plans chunks of `chunk` actions, whose components are the number of the call + the place in the chunk / 100."""

    def __init__(self, chunk: int, execute: int) -> None:
        self.info: dict[str, Any] = {}
        self.execute, self._chunk = execute, chunk

    def reset(self, instruction: str, seed: int) -> None:
        """Start counting."""
        self.calls = 0

    def act(self, observation: Observation) -> Array:
        """Not called by those who plan."""
        raise NotImplementedError

    def plan(self, observation: Observation) -> Array:
        """The next chunk."""
        self.calls += 1
        return (self.calls + np.arange(self._chunk)[:, None] / 100 + np.zeros(3)).astype(np.float32)


def acted(
    network: Network, chunk: int, execute: int, steps: int, seed: int = 0, hz: float | None = None
) -> list[float]:
    """The moves of `steps` steps; with `hz` they follow the clock."""
    spec = replace(SPEC, control_hz=hz or SPEC.control_hz)
    observation = SPEC.random_observation(np.random.default_rng(0))
    with closing(OverNetwork(Counting(chunk, execute), network, spec, by_clock=hz is not None)) as agent:
        agent.reset("", seed)
        actions = [agent.act(observation) for _ in range(steps)]
    assert all(action.shape == (3,) and action.dtype == np.float32 for action in actions)
    assert all(np.all(action[1:] == (action[0] or action[1])) and action[1] for action in actions)  # held, not zero
    return [round(float(action[0]), 2) for action in actions]


def test_without_latency_the_first_actions_of_each_chunk_act() -> None:
    assert acted(network_of(0.0), 4, 2, 5) == [1.00, 1.01, 2.00, 2.01, 3.00]


def test_a_chunk_goes_on_until_the_next_arrives_which_skips_what_is_past() -> None:
    # 10 Hz: the second observation, at step 2, is answered at step 4, of which two actions are past by then.
    assert acted(network_of(0.2), 5, 2, 7) == [1.00, 1.01, 1.02, 1.03, 2.02, 2.03, 3.02]
    assert acted(network_of(0.11), 5, 2, 7) == acted(
        network_of(0.2), 5, 2, 7
    )  # an answer between steps is for the later


def test_an_arm_without_actions_holds_and_its_plan_does_not_age() -> None:
    assert acted(network_of(0.2), 1, 1, 7) == [1.00, 0, 0, 2.00, 0, 0, 3.00]
    # Asked at step 2, out of actions at step 3 with one executed in between, answered at step 5.
    assert acted(network_of(0.3), 3, 2, 7) == [1.00, 1.01, 1.02, 0, 0, 2.01, 2.02]


def test_jitter_and_loss_are_drawn_from_the_seed() -> None:
    for network in (network_of(0.0, jitter=0.5), network_of(0.1, loss=0.5)):
        once, again, other = (acted(network, 4, 2, 40, seed) for seed in (1, 1, 2))
        assert once == again != other
    every, some = acted(network_of(0.1), 1, 1, 40), acted(network_of(0.1, loss=0.5), 1, 1, 40)
    assert max(every) == np.count_nonzero(every) == 20.0
    assert np.count_nonzero(some) < max(some) <= 40.0  # calls of which nothing was heard again


def test_chunks_for_the_same_step_are_averaged_with_the_oldest_first() -> None:
    schedule = Schedule(ensemble=0.5)
    for value in (1.0, 2.0):
        schedule.add(np.full((3, 1), value, np.float32), schedule.step)
        last = schedule.next()
    weights = np.exp([0.0, -0.5])
    assert last is not None and last == pytest.approx((weights[0] * 1 + weights[1] * 2) / weights.sum())
    steps = [schedule.next() for _ in range(3)]
    assert steps[0] == pytest.approx(last) and steps[1] == pytest.approx(2.0) and steps[2] is None
    # A chunk a step: of the third step there are three.
    assert acted(network_of(0.0, ensemble=0.0), 3, 3, 3) == [1.00, 1.5, 2.01]


def test_an_evaluation_without_latency_is_that_of_the_policy_and_with_latency_repeatable() -> None:
    policy = as_policy(make_act(chunk=4, execute=2))
    expected = rollout(toy.make_environment(), as_policy(policy.model), FIRST_SEED)
    here = rollout(toy.make_environment(), OverNetwork(as_policy(policy.model), network_of(0.0), toy.SPEC), FIRST_SEED)
    np.testing.assert_array_equal(here.executed, expected.executed)
    late = [
        rollout(
            toy.make_environment(),
            OverNetwork(as_policy(policy.model), network_of(0.2, 0.1, 0.1), toy.SPEC),
            FIRST_SEED,
        )
        for _ in range(2)
    ]
    np.testing.assert_array_equal(late[0].executed, late[1].executed)
    assert not np.array_equal(late[0].executed, expected.executed)


def test_by_the_clock_a_chunk_goes_on_while_the_next_one_is_under_way() -> None:
    assert acted(network_of(0.0), 3, 3, 1, hz=1000.0) == [1.0]
    # The first answer is waited for; whatever is sent afterwards is lost, and the arm holds.
    assert acted(network_of(0.001, loss=1.0), 3, 2, 40, hz=1000.0) == [1.0, 1.01, 1.02, *[0.0] * 37]
    # An answer that takes longer than the episode.
    assert acted(network_of(0.3), 3, 1, 5, hz=1000.0) == [1.0, 1.01, 1.02, 0.0, 0.0]
    moves = acted(network_of(0.2), 40, 2, 120, hz=100.0)
    assert moves[0] == 1.0 and max(moves) > 2 and not np.isin([2.0, 3.0], moves).any()  # what is past is skipped


def test_latency_costs_steps_and_then_success() -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + 10)
    at_once, late, later = (
        evaluate(toy.make_environment, partial(make_over_network, toy.make_expert, network_of(latency)), None, seeds)
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
    seen = spec.random_observation(np.random.default_rng(0))
    np.testing.assert_allclose([acting.act(seen) for _ in range(2)], [[0.03] * 3, [0, 0, 0.03]])


def test_an_error_of_the_policy_is_one_of_the_episode() -> None:
    def fail(observation: Observation) -> Array:
        raise ValueError("the policy server failed")

    acting = RealTime(SPEC, SimulatedLink(fail, network_of(0.1), 10.0), lambda: 1, None)
    with pytest.raises(ValueError, match="server failed"):
        acting.act(SPEC.random_observation(np.random.default_rng(0)))


def test_an_agent_with_a_history_sees_every_frame() -> None:
    agent = Counting(3, 3)
    agent.history = 2  # type: ignore[attr-defined]
    distant = OverNetwork(agent, network_of(0.0), SPEC)
    distant.reset("", 0)
    observation = SPEC.random_observation(np.random.default_rng(0))
    for _ in range(4):
        distant.act(observation)
    assert agent.calls == 4
