"""Asynchronous execution of chunks: one is executed while the next is computed; actions that arrive late are skipped.

The schedule counts executed actions, not time. While the arm holds for lack of an action, the schedule does not
advance, and no action becomes obsolete.

Shapes: k action chunk, D action components.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from vla.io.types import NonNegative, Rate
from vla.rollouts.rollout import AgentFactory, close_agent
from vla.spec import Agent, Array, Environment, Observation, Spec

Plan = Callable[[Observation], Array]  # returns a chunk (k, D)


@dataclass(frozen=True)
class Network:
    """A simulated network between an arm and its policy.

    Attributes:
        latency: shortest time from an observation to its actions, inference included [s].
        jitter: largest addition to it, uniformly distributed [s].
        loss: probability that an observation or its answer is lost; another one is sent when the longest time is over.
        ensemble: as of `Schedule`.
    """

    latency: NonNegative
    jitter: NonNegative
    loss: Rate
    ensemble: NonNegative | None

    def draw(self, random: np.random.Generator) -> tuple[float, bool]:
        """Return the time from an observation to its answer [s], and whether that is lost."""
        late, lost = random.random(2)
        lost = bool(lost < self.loss)
        return self.latency + self.jitter * (1.0 if lost else late), lost


IDEAL = Network(latency=0.0, jitter=0.0, loss=0.0, ensemble=None)


class Schedule:
    """The actions of the chunks so far, by the number of the step at which they are due; steps are executed actions."""

    def __init__(self, ensemble: float | None) -> None:
        """`ensemble` is None, or the m of weights exp(-m i) of all chunks for a step, i = 0 for the oldest.

        Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware, arXiv 2304.13705,
        algorithm 2.
        """
        self._ensemble = ensemble
        self._chunks: list[tuple[int, Array]] = []  # first step, actions
        self.step = 0  # the next one

    def add(self, actions: Array, observed: int) -> None:
        """Add a chunk (k, D) of an observation before the step `observed`; actions for past steps are skipped."""
        self._chunks.append((observed, actions))

    def is_due(self, execute: int) -> bool:
        """Return whether the next observation is wanted, `execute` steps after that of the newest chunk."""
        return not self._chunks or self.step >= self._chunks[-1][0] + execute

    def next(self) -> Array | None:
        """Return the action (D,) of the next step, and advance; None if no chunk reaches that far."""
        self._chunks = [(first, actions) for first, actions in self._chunks if self.step < first + len(actions)]
        if not self._chunks:
            return None
        found = np.stack([actions[self.step - first] for first, actions in self._chunks])
        self.step += 1
        if self._ensemble is None:
            return found[-1]
        weights = np.exp(-self._ensemble * np.arange(len(found)))
        return (weights @ found / weights.sum()).astype(np.float32)


class RealTime:
    """Acts at every step with the newest chunk that has arrived, and holds where there is none.

    The first action waits for the first chunk. Holding repeats the last action, but with zero in relative components:
    those with a unit and bounds on both sides of zero that are not part of the state, as absolute positions are. A
    component without a unit, such as a gripper command, is repeated.
    """

    def __init__(
        self,
        spec: Spec,
        link: SimulatedLink | BackgroundLink,
        execute: Callable[[], int],
        ensemble: float | None,
    ) -> None:
        """Args:
        spec: of the actions.
        link: to the policy.
        execute: returns the number of actions after which the next observation is sent, once an answer is there.
        ensemble: as of `Schedule`: average the actions of all chunks for a step, and send every observation.
        """
        self._link, self._execute, self._ensemble = link, execute, ensemble
        columns = zip(spec.action, spec.units, spec.low, spec.high, strict=True)
        moves = [unit != "1" and low < 0 < high and name not in spec.state for name, unit, low, high in columns]
        self._kept = ~np.array(moves)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        self._link.reset(seed)
        self._schedule, self._observed = Schedule(self._ensemble), 0
        self._last: Array | None = None

    def act(self, observation: Observation) -> Array:
        """Return the action (D,) to execute now. Raises what the policy raises."""
        self._link.tick()
        self._take(wait=False)
        execute = 1 if self._ensemble is not None or self._last is None else self._execute()
        if not self._link.busy and self._schedule.is_due(execute):
            self._link.send(observation)
            self._observed = self._schedule.step
            self._take(wait=self._last is None)
        action = self._schedule.next()
        if action is None:
            assert self._last is not None, "the first answer has actions"
            return np.where(self._kept, self._last, 0).astype(np.float32)
        self._last = action
        return action

    def _take(self, wait: bool) -> None:
        actions = self._link.receive(wait) if self._link.busy else None
        if actions is not None:
            self._schedule.add(actions, self._observed)


class SimulatedLink:
    """Link to a policy with simulated delays in control steps, drawn from the seed; one request at a time."""

    def __init__(self, plan: Plan, network: Network, control_hz: float) -> None:
        """Args: the policy; the network; steps per second [Hz]."""
        self._plan, self._network, self._hz = plan, network, control_hz
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        self._random = np.random.default_rng([seed, 3])
        self._now, self.busy = 0, False

    def tick(self) -> None:
        """Begin a control step."""
        self._now += 1

    def send(self, observation: Observation) -> None:
        """Compute the chunk, and draw when it arrives; a server computes one that is lost on its way back, too."""
        seconds, self._lost = self._network.draw(self._random)
        steps = math.ceil(seconds * self._hz - 1e-9)
        self._due = self._now + (max(steps, 1) if self._lost else steps)
        self._actions, self.busy = self._plan(observation), True

    def receive(self, wait: bool) -> Array | None:
        """Return the chunk (k, D) if it has arrived, which ends the wait; with `wait` it always has."""
        if self._now < self._due and not wait:
            return None
        self.busy = False
        return None if self._lost and not wait else self._actions


class BackgroundLink:
    """Link to a policy that plans in a background thread, in real time; late control steps are not caught up."""

    def __init__(self, plan: Plan, control_hz: float, network: Network = IDEAL) -> None:
        """Args: the policy; steps per second [Hz]; a network in front of it whose delays pass by the clock."""
        self._plan, self._period = plan, 1 / control_hz
        self._network = network
        self._thread = ThreadPoolExecutor(1, "policy")
        self._answer: Future[tuple[Array, bool]] | None = None
        self.reset(0)

    @property
    def busy(self) -> bool:
        """True while an answer is awaited."""
        return self._answer is not None

    def reset(self, seed: int) -> None:
        """Start an episode once the policy is idle."""
        if self._answer is not None:
            self._answer.exception()
        self._answer, self._next = None, 0.0
        self._random = np.random.default_rng([seed, 3])

    def tick(self) -> None:
        """Wait for the next control step."""
        now = time.monotonic()
        time.sleep(max(0.0, self._next - now))
        self._next = max(now, self._next) + self._period

    def send(self, observation: Observation) -> None:
        """Let the thread plan."""
        self._answer = self._thread.submit(self._ask, observation)

    def _ask(self, observation: Observation) -> tuple[Array, bool]:
        """Return the chunk when it arrives, and whether it is lost."""
        began = time.monotonic()
        seconds, lost = self._network.draw(self._random)
        actions = self._plan(observation)
        time.sleep(max(0.0, began + seconds - time.monotonic()))
        return actions, lost

    def receive(self, wait: bool) -> Array | None:
        """Return the chunk (k, D) if it is there, or with `wait` once it is; raises what the policy raised."""
        if self._answer is None or not (wait or self._answer.done()):
            return None
        answer, self._answer = self._answer, None
        actions, lost = answer.result()
        return None if lost and not wait else actions

    def close(self) -> None:
        """End the thread once the policy is idle."""
        self._thread.shutdown()


class OverNetwork:
    """An agent at the other end of a simulated network; one that does not plan chunks has chunks of one action."""

    def __init__(self, agent: Agent, network: Network, spec: Spec, by_clock: bool = False) -> None:
        """Args: the agent, the network, the spec of the environment, and whether time passes by the clock."""
        self._agent = agent
        plan: Plan = getattr(agent, "plan", lambda observation: agent.act(observation)[None])
        self._thread = BackgroundLink(plan, spec.control_hz, network) if by_clock else None
        link = self._thread or SimulatedLink(plan, network, spec.control_hz)
        self._real_time = RealTime(spec, link, self._execute, network.ensemble)
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode."""
        self._real_time.reset(seed)  # first, because it waits until the policy is idle
        self._agent.reset(instruction, seed)

    def _execute(self) -> int:
        """Return how many actions to execute before the next observation; a history wants to see every one."""
        return 1 if getattr(self._agent, "history", 1) > 1 else getattr(self._agent, "execute", None) or 1

    def act(self, observation: Observation) -> Array:
        """Return the action (D,) to execute now."""
        return self._real_time.act(observation)

    def close(self) -> None:
        """End the thread once the agent is idle, and close the agent."""
        if self._thread is not None:
            self._thread.close()
        close_agent(self._agent)


def make_over_network(
    make_agent: AgentFactory, network: Network, environment: Environment, by_clock: bool = False
) -> OverNetwork:
    """Build an agent at the other end of a network for an environment."""
    return OverNetwork(make_agent(environment), network, environment.spec, by_clock)
