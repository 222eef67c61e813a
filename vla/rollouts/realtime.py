"""Asynchronous execution of chunks: one is executed while the next is computed; actions that arrive late are skipped.

`vla.schedule.Schedule` determines which action is due; its time is the number of executed actions.

Shapes: k action chunk, D action components.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from vla.io.types import NonNegative, Rate
from vla.rollouts.rollout import AgentFactory, close_agent
from vla.schedule import Delays, Schedule
from vla.spec import Array, Environment, Observation, RunningPlan, Spec

Plan = Callable[[Observation], Array]  # returns a chunk (k, D)


@dataclass(frozen=True)
class Network:
    """A simulated network between an arm and its policy.

    Attributes:
        latency: shortest time from an observation to its actions, inference included [s].
        jitter: largest addition to it, uniformly distributed [s].
        loss: probability that an observation or its answer is lost; the next one is sent after the longest time.
        ensemble: m in the weights of the mean over all chunks for a step, see `weighted_mean`; None: the newest counts.
    """

    latency: NonNegative
    jitter: NonNegative
    loss: Rate
    ensemble: NonNegative | None


IDEAL = Network(latency=0.0, jitter=0.0, loss=0.0, ensemble=None)


class RealTime:
    """Acts at every step with the newest chunk that has arrived, and holds where there is none.

    The first action waits for the first chunk. Holding repeats the last action, but with zero in relative components:
    those with a unit and bounds on both sides of zero that are not part of the state, as absolute positions are. A
    component without a unit, such as a gripper command, is repeated.
    """

    def __init__(
        self, spec: Spec, link: SimulatedLink | BackgroundLink, execute: Callable[[], int], ensemble: float | None
    ) -> None:
        """Act through a link to a policy.

        `execute` returns the number of executed actions of a chunk after which the next observation is sent; with an
        `ensemble`, see `Network`, that is 1. Nothing is sent while an answer is pending.
        """
        self._link, self._execute, self._ensemble = link, execute, ensemble
        columns = zip(spec.action, spec.units, spec.low, spec.high, strict=True)
        self._relative = np.array(
            [unit != "1" and low < 0 < high and name not in spec.state for name, unit, low, high in columns]
        )
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start an episode, once the policy is idle."""
        self._link.reset(seed)
        self._schedule, self._step, self._sent_step = Schedule[Array](), 0, 0
        self._answer: DelayedChunk | Future[Array] | None = None
        self._last_action: Array | None = None

    def act(self, observation: Observation) -> Array:
        """Return the action (D,) to execute now. Raises what the policy raises."""
        first = self._last_action is None
        self._link.tick()
        self._take()
        if self._answer is None and self._wants_plan():
            self._answer, self._sent_step = self._link.send(self._with_plan(observation), first), self._step
            self._take(wait=first)
        if actions := self._schedule.actions_at(self._step):
            self._step += 1  # only now: while the arm holds, no action becomes obsolete
            self._last_action = actions[-1] if self._ensemble is None else weighted_mean(actions, self._ensemble)
            return self._last_action
        assert self._last_action is not None, "the first answer has actions"
        return np.where(self._relative, 0, self._last_action).astype(np.float32)

    @property
    def looks(self) -> bool:
        """Whether the next observation may be sent; what is not sent is not read."""
        return self._answer is not None or self._wants_plan()

    def _wants_plan(self) -> bool:
        execute = 1 if self._last_action is None or self._ensemble is not None else self._execute()
        return self._schedule.wants_plan(self._step, execute)

    def _with_plan(self, observation: Observation) -> Observation:
        """Return the observation with the rest of the plan that is executed until the next one arrives."""
        rest = self._schedule.remaining_actions(self._step)
        if not rest or self._ensemble is not None:
            return observation
        return replace(observation, running=RunningPlan(np.stack(rest), min(self._link.delays.forecast, len(rest))))

    def _take(self, wait: bool = False) -> None:
        if self._answer is not None and (wait or self._answer.done()):
            answer, self._answer = self._answer, None
            if (actions := answer.result()) is not None:
                self._schedule.add(list(actions), self._sent_step)


def weighted_mean(actions: Sequence[Array], ensemble: float) -> Array:
    """Return the mean of actions (D,) with weights exp(-m i), m = `ensemble`, i = 0 for the first, the oldest.

    Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware, arXiv 2304.13705,
    algorithm 2.
    """
    weights = np.exp(-ensemble * np.arange(len(actions)))
    return (weights @ np.stack(actions) / weights.sum()).astype(np.float32)


class SimulatedLink:
    """Link to a policy with simulated delays in control steps, drawn from the seed; one request at a time."""

    def __init__(self, plan: Plan, network: Network, control_hz: float) -> None:
        """Put a policy behind a network; `control_hz` is the number of steps per second [Hz]."""
        self._plan, self._network, self._hz = plan, network, control_hz
        self.delays = Delays(1 / control_hz)
        self.delays.add(network.latency + network.jitter)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        self._random, self.now = np.random.default_rng([seed, 3]), 0

    def tick(self) -> None:
        """Begin a control step."""
        self.now += 1

    def send(self, observation: Observation, is_first: bool) -> DelayedChunk:
        """Compute the chunk, and draw when it arrives; if it `is_first`, it is never lost."""
        network, (share, draw) = self._network, self._random.random(2)
        lost = draw < network.loss
        seconds = network.latency + network.jitter * (1.0 if lost else share)
        steps = math.ceil(seconds * self._hz - 1e-9)
        actions = self._plan(observation)  # even if it is lost, which happens on the way back
        return DelayedChunk(
            self, self.now + (max(steps, 1) if lost else steps), None if lost and not is_first else actions
        )


@dataclass(frozen=True)
class DelayedChunk:
    """A chunk that arrives at the step `arrival_step` of a simulated link."""

    link: SimulatedLink
    arrival_step: int
    actions: Array | None  # None: lost

    def done(self) -> bool:
        """Return whether it has arrived, or never will."""
        return self.link.now >= self.arrival_step

    def result(self) -> Array | None:
        """Return the chunk (k, D), or None if it was lost."""
        return self.actions


class BackgroundLink:
    """Link to a policy that plans in a background thread, in real time; late control steps are not caught up."""

    def __init__(self, plan: Plan, control_hz: float) -> None:
        """Start the thread of a policy that acts `control_hz` times per second [Hz]."""
        self._plan, self._period = plan, 1 / control_hz
        self._thread = ThreadPoolExecutor(1, "policy")
        self.delays = Delays(self._period)
        self._next_time = 0.0  # when the next control step begins

    def reset(self, seed: int) -> None:
        """Start an episode once the policy is idle."""
        self._thread.submit(int).result()  # after what was submitted before
        self._next_time = 0.0

    def tick(self) -> None:
        """Wait for the next control step."""
        now = time.monotonic()
        time.sleep(max(0.0, self._next_time - now))
        self._next_time = max(now, self._next_time) + self._period

    def send(self, observation: Observation, is_first: bool) -> Future[Array]:
        """Let the thread plan."""
        return self._thread.submit(self._time_plan, observation)

    def _time_plan(self, observation: Observation) -> Array:
        start = time.monotonic()
        actions = self._plan(observation)
        self.delays.add(time.monotonic() - start)
        return actions

    def close(self) -> None:
        """End the thread once the policy is idle."""
        self._thread.shutdown()


def actions_per_plan(agent: Any) -> int:
    """Return how many actions of a plan are executed: one with a history, as in training its frames have no gaps."""
    return 1 if getattr(agent, "history", 1) > 1 else getattr(agent, "execute", None) or 1


class NetworkedAgent:
    """An agent at the other end of a simulated network; one that does not plan chunks has chunks of one action."""

    def __init__(self, make_agent: AgentFactory, network: Network, environment: Environment) -> None:
        """Put the agent that a factory makes for the environment behind a network."""
        agent, spec = make_agent(environment), environment.spec
        self._agent = agent
        plan: Plan = getattr(agent, "plan", lambda observation: agent.act(observation)[None])
        link = SimulatedLink(plan, network, spec.control_hz)
        self._real_time = RealTime(spec, link, partial(actions_per_plan, agent), network.ensemble)
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode."""
        self._real_time.reset(seed)
        self._agent.reset(instruction, seed)

    @property
    def looks(self) -> bool:
        """Whether the next observation may be sent."""
        return self._real_time.looks

    def act(self, observation: Observation) -> Array:
        """Return the action (D,) to execute now."""
        return self._real_time.act(observation)

    def close(self) -> None:
        """Close the agent."""
        close_agent(self._agent)
