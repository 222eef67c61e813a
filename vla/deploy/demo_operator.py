"""The operator of the closed-loop demo."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from threading import Event
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from vla.deploy.calls import CHANGE, RESET, STATUS
from vla.deploy.messages import SimulatedEpisode
from vla.io.errors import UserError
from vla.rollouts.motion import Motion
from vla.rollouts.results import Result

log = logging.getLogger(__name__)

START = 60.0  # longest start of both nodes [s]
ANSWER = 10.0  # longest service call [s]
EPISODE = 60.0  # longest episode [s]


class DemoOperator:
    """Starts episodes, sends the instructions and monitors both nodes."""

    def __init__(self, instruction_topic: str, stopped: Event, agent: BaseProcess, simulator: BaseProcess) -> None:
        """Args: topic of the instructions; an event that is set on interruption; the processes of the nodes.

        Raises:
            UserError: a node exited or does not respond, here and in all methods.
        """
        self.stopped, self.agent, self.simulator = stopped, agent, simulator
        self.node = rclpy.create_node("vla_operator")
        self._change = self.node.create_client(ChangeState, CHANGE)
        self._reset = self.node.create_client(Trigger, RESET)
        self._instruction = self.node.create_publisher(String, instruction_topic, 1)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/vla_simulator/episode", self._on_episode, latched)
        self.node.create_subscription(DiagnosticStatus, STATUS, self._on_status, 10)
        self._episode: SimulatedEpisode | None = None
        self.status: dict[str, str] = {}  # of the last status message of the agent
        self.wait(lambda: self._change.service_is_ready() and self._reset.service_is_ready(), START, "the nodes")
        self.wait(lambda: self._instruction.get_subscription_count() >= 2, START, "both nodes to subscribe")

    def play(self) -> Result | None:
        """Play one episode; return None if it was interrupted."""
        self.begin_episode()
        self.wait(lambda: not self._playing or self.stopped.is_set(), EPISODE, "the end of an episode")
        episode = self._episode
        assert episode is not None
        if not episode.done:
            return None
        details = {"task": episode.task, "milestones": episode.milestones, "motion": Motion(round(episode.seconds, 1))}
        return Result(episode.seed, episode.outcome, episode.instruction, episode.steps, **details)

    def begin_episode(self) -> None:
        """Deactivate the agent, reset the simulator, activate the agent and send the instruction."""

        def change(number: int) -> None:
            request = ChangeState.Request(transition=Transition(id=number))
            self._call(self._change, request, "change its state")

        change(Transition.TRANSITION_DEACTIVATE)  # the reset moves the arm
        if self._episode is not None and self._episode.done:
            self._episode = None
            self._call(self._reset, Trigger.Request(), "begin an episode")
        self.wait(lambda: self._playing, ANSWER, "an episode")
        change(Transition.TRANSITION_ACTIVATE)
        assert self._episode is not None
        self._instruction.publish(String(data=self._episode.instruction))

    def watchdog_delay(self) -> float:
        """Suspend the simulator until the agent holds the arm; returns the delay [s]."""
        assert self.simulator.pid is not None
        self.wait(lambda: self.status.get("state") == "running", ANSWER, "the agent to run")
        os.kill(self.simulator.pid, signal.SIGSTOP)
        started = time.monotonic()
        try:
            self.wait(lambda: self.status["state"] == "holding", ANSWER, "the agent to hold")
            return time.monotonic() - started
        finally:
            os.kill(self.simulator.pid, signal.SIGCONT)

    def wait(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        """Spin until the condition `what` holds, for at most some seconds."""
        deadline = time.monotonic() + seconds
        while not condition():
            if not (self.agent.is_alive() and self.simulator.is_alive()):
                raise UserError("a node has exited, see its log above")
            if time.monotonic() > deadline:
                raise UserError(f"timed out after {seconds:g} s: waiting for {what}")
            rclpy.spin_once(self.node, timeout_sec=0.02)

    @property
    def _playing(self) -> bool:
        return self._episode is not None and not self._episode.done

    def _on_status(self, status: Any) -> None:
        self.status = {pair.key: pair.value for pair in status.values}

    def _on_episode(self, message: Any) -> None:
        try:
            self._episode = SimulatedEpisode.of(message)
        except UserError as error:  # anybody on the network can send one
            log.warning("dropped a message: %s", error)

    def _call(self, client: Any, request: Any, what: str) -> None:
        answer = client.call_async(request)
        self.wait(answer.done, ANSWER, f"a node to {what}")
        if not answer.result().success:
            raise UserError(f"a node refused to {what}, see its log above")
