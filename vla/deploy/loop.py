"""The whole demonstration on one machine: simulator node, policy node, and a person who says what to do."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from vla.deploy.bag import Recorder
from vla.deploy.ros import ros
from vla.deploy.ros2 import Ros2, Simulated
from vla.evaluate import Report, Result

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
        record: write all messages into a bag in the output folder, which Rerun opens.
        policy, environment, output: given by the job.
        figures: what the agent said of itself at last, such as "image to command p50 [ms]".
    """

    agent: Callable[..., Ros2]
    simulator: Callable[..., Simulated]
    episodes: int = 20
    record: bool = True
    policy: Callable[[], Policy]
    environment: Callable[[], Tabletop]
    output: Path
    figures: dict[str, str] = field(init=False, default_factory=dict)

    def run(self) -> Report:
        """Play all episodes.

        Raises:
            ValueError: a node ended, or did not answer.
        """
        given = {"policy": self.policy, "environment": self.environment, "output": self.output}
        agent, simulator = self.agent(**given), self.simulator(**given)
        processes = get_context("spawn")
        nodes = [processes.Process(target=node.run, daemon=True) for node in (agent, simulator)]
        for node in nodes:
            node.start()
        try:
            with ros(agent.network, self.output) as stopped:
                person = Person(agent, stopped, lambda: all(node.is_alive() for node in nodes))
                recorder = Recorder(person.node, self.output / "bag") if self.record else None
                results: list[Result] = []
                while len(results) < self.episodes and not stopped.is_set():
                    results.append(person.play())
                    log.info("seed %d: %s", results[-1].seed, results[-1].outcome)
                if recorder is not None:
                    recorder.close()
                    log.info("rerun %s shows what the nodes said", *(self.output / "bag").glob("*.mcap"))
                self.figures = person.figures
                log.info("%s", ", ".join(f"{key} {value}" for key, value in self.figures.items() if "[ms]" in key))
                person.node.destroy_node()
        finally:
            for node in nodes:
                node.terminate()
            for node in nodes:
                node.join(timeout=5.0)
        return Report(tuple(results))


class Person:
    """Starts episodes, tells the agent what to do, and watches."""

    def __init__(self, agent: Ros2, stopped: Event, alive: Callable[[], bool]) -> None:
        """Args: the agent's settings; set when interrupted; whether both nodes still run."""
        import rclpy
        from diagnostic_msgs.msg import DiagnosticStatus
        from lifecycle_msgs.srv import ChangeState
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        self._stopped, self._alive = stopped, alive
        self.node = rclpy.create_node("vla_person")
        self._change = self.node.create_client(ChangeState, "/vla_agent/change_state")
        self._reset = self.node.create_client(Trigger, "/vla_simulator/reset")
        self._say = self.node.create_publisher(String, agent.topics.instruction, 1)
        lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/vla_simulator/episode", self._hear, lasting)
        self.node.create_subscription(DiagnosticStatus, "/vla_agent/status", self._note, 10)
        self._episode: dict[str, Any] = {}
        self.figures: dict[str, str] = {}
        self._until(lambda: self._change.service_is_ready() and self._reset.service_is_ready(), START, "the nodes")
        self._until(lambda: self._say.get_subscription_count() >= 2, START, "both nodes to listen")

    def play(self) -> Result:
        """One episode: the arm is let go, the world reset, the arm taken over, the instruction said."""
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
        self._until(lambda: bool(self._episode) and not self._episode["done"], ANSWER, "an episode")
        change(Transition.TRANSITION_ACTIVATE)
        self._say.publish(String(data=self._episode["instruction"]))
        started = time.monotonic()
        self._until(lambda: bool(self._episode["done"]) or self._stopped.is_set(), EPISODE, "the end of an episode")
        seconds = round(10 * (time.monotonic() - started))
        return Result(self._episode["seed"], self._episode["outcome"], self._episode["instruction"], seconds)

    def _note(self, status: Any) -> None:
        self.figures = {pair.key: pair.value for pair in status.values}

    def _hear(self, message: Any) -> None:
        self._episode = json.loads(message.data)

    def _ask(self, client: Any, request: Any, what: str) -> None:
        answer = client.call_async(request)
        self._until(answer.done, ANSWER, f"a node to {what}")
        if not answer.result().success:
            raise ValueError(f"a node refused to {what}, its log above says why")

    def _until(self, true: Callable[[], bool], seconds: float, what: str) -> None:
        import rclpy

        give_up = time.monotonic() + seconds
        while not true():
            if not self._alive():
                raise ValueError("a node has ended, its log above says why")
            if time.monotonic() > give_up:
                raise ValueError(f"waited {seconds:g} s for {what}")
            rclpy.spin_once(self.node, timeout_sec=0.02)
