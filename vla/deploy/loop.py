"""The whole demonstration on one machine: simulator node, policy node, and a person who says what to do."""

from __future__ import annotations

import json
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from vla.deploy.bag import Recorder
from vla.deploy.overhear import Eavesdropper
from vla.deploy.ros import plain_errors, ros
from vla.deploy.ros2 import Ros2, Simulated
from vla.evaluate import Report, Result
from vla.tasks.backend import choose_backend
from vla.types import Count

if TYPE_CHECKING:
    from vla.policy import Policy
    from vla.tasks.tabletop import Tabletop

log = logging.getLogger(__name__)

START = 60.0  # for both nodes to be there [s]
ANSWER = 10.0  # for a service to answer [s]
EPISODE = 60.0  # for an episode to end [s]


@dataclass(kw_only=True)
class Loop:
    """Plays episodes over ROS and reports them as an evaluation would.

    Attributes:
        agent, simulator: make the two nodes, called with what the job gives.
        episodes: how many.
        record: leave in the output folder a recording of what the agent saw and commanded, `session.rrd`, and all
            messages as a bag.
        policy, environment, output: given by the job.
    """

    agent: Callable[..., Ros2]
    simulator: Callable[..., Simulated]
    episodes: Count = 20
    record: bool = True
    policy: Callable[[], Policy]
    environment: Callable[[], Tabletop]
    output: Path

    def run(self) -> Report:
        """Play all episodes.

        Raises:
            ValueError: a node ended, or did not answer.
        """
        with self.playing() as person:
            results: list[Result] = []
            while len(results) < self.episodes and not person.stopped.is_set():
                results.append(person.play())
                log.info("seed %d: %s", results[-1].seed, results[-1].outcome)
            log.info("%s", ", ".join(f"{key} {value}" for key, value in person.status.items() if "[ms]" in key))
        return Report(tuple(results))

    @contextmanager
    def playing(self) -> Iterator[Person]:
        """Both nodes at work, recorded if so configured, and the person who talks to them."""
        given = {"policy": self.policy, "environment": self.environment, "output": self.output}
        agent, simulator = self.agent(**given), self.simulator(**given)
        processes = get_context("spawn")
        nodes = [processes.Process(target=_run, args=(node,), daemon=True) for node in (agent, simulator)]
        for node in nodes:
            node.start()
        try:
            with ros(agent.network, self.output) as stopped:
                person = Person(agent, stopped, *nodes)
                listeners = self._recorders(person.node) if self.record else []
                yield person
                for listener in listeners:
                    listener.close()
                person.node.destroy_node()
        finally:
            for node in nodes:
                node.terminate()
            for node in nodes:
                node.join(timeout=5.0)

    def _recorders(self, node: Any) -> list[Eavesdropper]:
        from vla.deploy.view import View

        log.info("rerun %s shows what the agent sees and commands", self.output / "session.rrd")
        return [Recorder(node, self.output / "bag"), View(node, self.output / "session.rrd")]


def _run(node: Ros2 | Simulated) -> None:
    """What the process of a node does; what the user can mend ends in one sentence."""
    choose_backend(required=False)  # also keeps out of this process what does not go with MuJoCo's renderer
    with plain_errors():
        node.run()


class Person:
    """Starts episodes, tells the agent what to do, and watches."""

    def __init__(self, settings: Ros2, stopped: Event, agent: BaseProcess, simulator: BaseProcess) -> None:
        """Args: the agent's settings; set when interrupted; the nodes' processes.

        Raises:
            ValueError: a node ended, or did not answer, here and in all methods.
        """
        import rclpy
        from diagnostic_msgs.msg import DiagnosticStatus
        from lifecycle_msgs.srv import ChangeState
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        self.stopped, self.agent, self.simulator = stopped, agent, simulator
        self.node = rclpy.create_node("vla_person")
        self._change = self.node.create_client(ChangeState, "/vla_agent/change_state")
        self._reset = self.node.create_client(Trigger, "/vla_simulator/reset")
        self._say = self.node.create_publisher(String, settings.topics.instruction, 1)
        lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/vla_simulator/episode", self._hear, lasting)
        self.node.create_subscription(DiagnosticStatus, "/vla_agent/status", self._note, 10)
        self._episode: dict[str, Any] = {}
        self.status: dict[str, str] = {}  # what the agent last said of itself
        self.wait(lambda: self._change.service_is_ready() and self._reset.service_is_ready(), START, "the nodes")
        self.wait(lambda: self._say.get_subscription_count() >= 2, START, "both nodes to listen")

    def play(self) -> Result:
        """One episode, to its end."""
        self.begin()
        started = time.monotonic()
        self.wait(lambda: bool(self._episode["done"]) or self.stopped.is_set(), EPISODE, "the end of an episode")
        seconds = round(10 * (time.monotonic() - started))
        return Result(self._episode["seed"], self._episode["outcome"], self._episode["instruction"], seconds)

    def begin(self) -> None:
        """Begin an episode: the arm is let go, the world reset, the arm taken over, the instruction said."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        def change(number: int) -> None:
            request = ChangeState.Request(transition=Transition(id=number))
            self._ask(self._change, request, "change its state")

        change(Transition.TRANSITION_DEACTIVATE)
        if self._episode.get("done"):
            self._episode = {}
            self._ask(self._reset, Trigger.Request(), "begin an episode")
        self.wait(lambda: bool(self._episode) and not self._episode["done"], ANSWER, "an episode")
        change(Transition.TRANSITION_ACTIVATE)
        self._say.publish(String(data=self._episode["instruction"]))

    def react(self) -> float:
        """How long the agent takes to hold when the simulator freezes [s]; it thaws, and the agent goes on."""
        assert self.simulator.pid is not None
        self.wait(lambda: self.status.get("state") == "running", ANSWER, "the agent to run")
        os.kill(self.simulator.pid, signal.SIGSTOP)
        started = time.monotonic()
        try:
            self.wait(lambda: self.status["state"] == "holding", ANSWER, "the agent to hold")
            return time.monotonic() - started
        finally:
            os.kill(self.simulator.pid, signal.SIGCONT)

    def _note(self, status: Any) -> None:
        self.status = {pair.key: pair.value for pair in status.values}

    def _hear(self, message: Any) -> None:
        self._episode = json.loads(message.data)

    def _ask(self, client: Any, request: Any, what: str) -> None:
        answer = client.call_async(request)
        self.wait(answer.done, ANSWER, f"a node to {what}")
        if not answer.result().success:
            raise ValueError(f"a node refused to {what}, its log above says why")

    def wait(self, true: Callable[[], bool], seconds: float, what: str) -> None:
        """Listen until something is true, for some seconds; `what` says what is waited for."""
        import rclpy

        give_up = time.monotonic() + seconds
        while not true():
            if not (self.agent.is_alive() and self.simulator.is_alive()):
                raise ValueError("a node has ended, its log above says why")
            if time.monotonic() > give_up:
                raise ValueError(f"waited {seconds:g} s for {what}")
            rclpy.spin_once(self.node, timeout_sec=0.02)
