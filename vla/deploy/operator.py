"""Operation of running nodes: instruct, resume and hand over the agent, and start the simulator's episodes."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from threading import Event
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.duration import Duration
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from vla.deploy.lifecycle_node import LATCHED_QOS
from vla.deploy.messages import SimulatedEpisode
from vla.io.documents import parse_json
from vla.io.errors import UserError
from vla.rollouts.motion import Motion
from vla.rollouts.results import Result

log = logging.getLogger(__name__)

TIMEOUT = 10.0  # of the discovery of a subscriber or service, of a service call, and of a status [s]
SETTLING_TIME = 0.7  # discovery is complete after so long without a new subscriber [s]
START = 600.0  # longest start of both nodes of the demo, with a large policy that is compiled or exported [s]
MAX_EPISODE_CHARACTERS = 100_000  # of a message about an episode
AGENT, SIMULATOR = "/vla_agent", "/vla_simulator"


class Operator:
    """Calls services of the agent and the simulator. All methods raise a UserError if a node is missing, does not
    respond, refuses or has exited.

    Args:
        node: calls them; it is spun here.
        topic: of the instructions.
        processes: those of the nodes, if they belong to the operator.
    """

    def __init__(self, node: Any, topic: str, processes: Sequence[BaseProcess] = ()) -> None:
        self.node, self._processes = node, processes
        self._words = node.create_publisher(String, topic, 10)
        self.status: DiagnosticStatus | None = None  # newest of the agent
        node.create_subscription(DiagnosticStatus, f"{AGENT}/status", self._on_status, LATCHED_QOS)

    @property
    def values(self) -> dict[str, str]:
        """Name → value in the newest status."""
        return {pair.key: pair.value for pair in self.status.values} if self.status else {}

    def wait(self, condition: Callable[[], bool], description: str, seconds: float = TIMEOUT) -> None:
        """Spin until a condition holds, of which there is a `description`, for at most some seconds."""
        deadline = time.monotonic() + seconds
        while not condition():
            if not all(process.is_alive() for process in self._processes):
                raise UserError("a node has exited, see its log above")
            if time.monotonic() > deadline:
                raise UserError(
                    f"timed out after {seconds:g} s, waiting for {description}: is its node running, and on the same "
                    "network and domain?"
                )
            rclpy.spin_once(self.node, timeout_sec=0.02)

    @contextmanager
    def client(self, kind: Any, service: str) -> Iterator[Any]:
        """Yield a client of a service once that is there."""
        client = self.node.create_client(kind, service)
        try:
            self.wait(client.service_is_ready, f"the service {service}")
            yield client
        finally:
            self.node.destroy_client(client)

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service and return its answer."""
        with self.client(kind, service) as client:
            answer = client.call_async(request)
            self.wait(answer.done, f"an answer of {service}")
            return answer.result()

    def say(self, instruction: str) -> None:
        """Publish an instruction once the agent and all other subscribers are discovered, and wait until they confirm
        it. Raises a UserError if the agent is not active, because it then ignores instructions, or if there is none;
        others, such as a recorder, have got the instruction then."""
        topic, found, since = self._words.topic_name, 0, time.monotonic()

        def settled() -> bool:  # they are discovered one by one, in any order: the simulator may come before the agent
            nonlocal found, since
            if (count := self._words.get_subscription_count()) != found:
                found, since = count, time.monotonic()
            names = [subscriber.node_name for subscriber in self.node.get_subscriptions_info_by_topic(topic)]
            return AGENT.strip("/") in names and time.monotonic() - since > SETTLING_TIME

        try:
            self.wait(settled, f"{AGENT} to subscribe to {topic}")
        except UserError:
            self._words.publish(String(data=instruction))
            self._words.wait_for_all_acked(Duration(seconds=TIMEOUT))
            raise
        self._words.publish(String(data=instruction))
        if not self._words.wait_for_all_acked(Duration(seconds=TIMEOUT)):
            raise UserError("a subscriber does not confirm the instruction: does one of the nodes hang?")
        state = self.call(GetState, f"{AGENT}/get_state", GetState.Request()).current_state
        if state.id != State.PRIMARY_STATE_ACTIVE:
            steps = ["activate"] if state.id == State.PRIMARY_STATE_INACTIVE else ["configure", "activate"]
            remedy = ", ".join(f"ros2 lifecycle set {AGENT} {step}" for step in steps)
            raise UserError(f"{AGENT} is {state.label} and ignores instructions: {remedy}")

    def describe(self) -> str:
        """Return the agent's status: its reason, then a line for each value."""
        self.wait(lambda: self.status is not None, f"a message on {AGENT}/status")
        end = time.monotonic() + SETTLING_TIME  # a late subscriber gets the last ten one by one, the oldest first
        self.wait(lambda: time.monotonic() > end, f"the newest message on {AGENT}/status")
        assert self.status is not None
        return "\n".join([self.status.message, *(f"  {name}: {value}" for name, value in self.values.items())])

    def resume(self) -> None:
        """Resume a stopped agent."""
        _require(self.call(Trigger, f"{AGENT}/resume", Trigger.Request()))

    def hand_over(self, to_person: bool) -> None:
        """Make the agent leave the arm to a person, or take it back."""
        _require(self.call(SetBool, f"{AGENT}/hand_over", SetBool.Request(data=to_person)))

    def next_episode(self, reset: bool = True) -> str:
        """Start the simulator's next episode, unless `reset` is False, and restart the agent, if it is active.

        The agent then waits for an instruction. Returns the simulator's description of the episode; "" without `reset`.
        """
        if reset:
            with self.client(Trigger, f"{SIMULATOR}/reset"):
                pass  # without a simulator the agent goes on
        client = self.node.create_client(ChangeState, f"{AGENT}/change_state")
        has_agent = client.wait_for_service(SETTLING_TIME)
        self.node.destroy_client(client)
        # The reset moves the arm: an active agent would pull it back.
        active = has_agent and self._change(Transition.TRANSITION_DEACTIVATE)
        description = str(self.call(Trigger, f"{SIMULATOR}/reset", Trigger.Request()).message) if reset else ""
        if active and not self._change(Transition.TRANSITION_ACTIVATE):
            raise UserError("the agent cannot be activated again, see its log")
        return description

    def _change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(ChangeState, f"{AGENT}/change_state", request).success)

    def _on_status(self, status: DiagnosticStatus) -> None:
        self.status = status


class DemoOperator(Operator):
    """Plays the episodes of the closed-loop demo; `stopped` is set on interruption, also while the nodes start."""

    def __init__(self, node: Any, topic: str, stopped: Event, agent: BaseProcess, simulator: BaseProcess) -> None:
        super().__init__(node, topic, (agent, simulator))
        self.stopped = stopped
        node.create_subscription(String, f"{SIMULATOR}/episode", self._on_episode, LATCHED_QOS)
        self._episode: SimulatedEpisode | None = None
        subscribers = self._words.get_subscription_count
        self.wait(lambda: subscribers() >= 2 or self.stopped.is_set(), "both nodes to subscribe", START)

    def play(self) -> Result | None:
        """Play one episode, after the last has ended; return None if it was interrupted."""
        is_over = self._episode is not None and self._episode.done
        if is_over:
            self._episode = None
        self.next_episode(reset=is_over)
        self.wait(lambda: self._playing, "an episode")
        assert self._episode is not None
        self._words.publish(String(data=self._episode.instruction))
        self.wait(lambda: not self._playing or self.stopped.is_set(), "the end of an episode", math.inf)
        episode = self._episode
        assert episode is not None
        if not episode.done:
            return None
        details = {"task": episode.task, "milestones": episode.milestones, "motion": Motion(round(episode.seconds, 1))}
        return Result(episode.seed, episode.outcome, episode.instruction, episode.steps, **details)

    @property
    def _playing(self) -> bool:
        return self._episode is not None and not self._episode.done

    def _on_episode(self, message: Any) -> None:
        try:
            text = message.data[:MAX_EPISODE_CHARACTERS]
            self._episode = parse_json(text, SimulatedEpisode, f"{SIMULATOR}/episode")
        except UserError as error:  # anybody on the network can send one
            log.warning("dropped a message: %s", error)


def require_alone(node: Any) -> None:
    """Raise a UserError if there is an agent, a simulator or another demo where `node` is, the operator of a demo."""
    time.sleep(SETTLING_TIME)  # until all are discovered
    names = node.get_node_names()
    limits = {AGENT.strip("/"): 0, SIMULATOR.strip("/"): 0, node.get_name(): 1}
    if others := [name for name, limit in limits.items() if names.count(name) > limit]:
        raise UserError(
            f"deploy=loop: {', '.join(others)} of another command is on the same network and domain: end that first, "
            "or set the environment variable ROS_DOMAIN_ID to another number"
        )


def _require(answer: Any) -> None:
    if not answer.success:
        raise UserError(answer.message)
