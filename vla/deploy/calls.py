"""Requests to running nodes: an instruction, the resumption of a stopped agent, the next episode of a simulator."""

from __future__ import annotations

import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from vla.io.errors import UserError

TIMEOUT = 10.0  # of the discovery of a subscriber or service, of a service call, and of a status [s]
SETTLED = 0.7  # discovery is complete after so long without a new subscriber [s]
HAND_OVER, RESUME, CHANGE = "/vla_agent/hand_over", "/vla_agent/resume", "/vla_agent/change_state"
STATUS, RESET = "/vla_agent/status", "/vla_simulator/reset"
HELP = "is its node running, and on the same network and domain?"


def say(node: Any, topic: str, instruction: str) -> None:
    """Publish an instruction once all subscribers are discovered; raise a UserError if none is, or confirms it."""
    publisher = node.create_publisher(String, topic, 1)
    subscribers, since = 0, time.monotonic()
    # Subscribers are discovered one by one, in any order: the simulator may come before the agent.
    while time.monotonic() - since < (SETTLED if subscribers else TIMEOUT):
        if publisher.get_subscription_count() != subscribers:
            subscribers, since = publisher.get_subscription_count(), time.monotonic()
        time.sleep(0.02)
    if publisher.get_subscription_count() == 0:
        raise UserError(f"no subscriber on {topic}: is the agent running, and on the same network and domain?")
    publisher.publish(String(data=instruction))
    if not publisher.wait_for_all_acked(Duration(seconds=TIMEOUT)):
        raise UserError(f"a subscriber on {topic} does not confirm the instruction: does one of the nodes hang?")


def state(node: Any) -> str:
    """Return the agent's status: its reason, then a line for each value; raise a UserError if there is no agent."""
    heard: list[DiagnosticStatus] = []
    node.create_subscription(DiagnosticStatus, STATUS, heard.append, 10)
    deadline = time.monotonic() + TIMEOUT
    while not heard and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    if not heard:
        raise UserError(f"no message on {STATUS}: {HELP}")
    return "\n".join([heard[-1].message, *(f"  {pair.key}: {pair.value}" for pair in heard[-1].values)])


def resume(node: Any) -> None:
    """Resume a stopped agent; raise a UserError if there is none, or it is not stopped."""
    _require(_call(node, Trigger, RESUME, Trigger.Request()))


def hand_over(node: Any, to_person: bool) -> None:
    """Make the agent leave the arm to a person, or take it back; raise a UserError if it refuses."""
    _require(_call(node, SetBool, HAND_OVER, SetBool.Request(data=to_person)))


def next_episode(node: Any) -> str:
    """Start the simulator's next episode and restart the agent, if there is one, which then waits for an instruction.

    Returns the simulator's description of the episode.

    Raises:
        UserError: there is no simulator, or a node does not respond.
    """

    def change(transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(_call(node, ChangeState, CHANGE, request).success)

    if not node.create_client(Trigger, RESET).wait_for_service(TIMEOUT):
        raise UserError(f"no service {RESET}: {HELP}")
    agent = node.create_client(ChangeState, CHANGE).wait_for_service(SETTLED)
    # The reset moves the arm: an active agent would pull it back.
    active = agent and change(Transition.TRANSITION_DEACTIVATE)
    description = str(_call(node, Trigger, RESET, Trigger.Request()).message)
    if active and not change(Transition.TRANSITION_ACTIVATE):
        raise UserError("the agent cannot be activated again, see its log")
    return description


def _require(answer: Any) -> None:
    if not answer.success:
        raise UserError(answer.message)


def _call(node: Any, kind: Any, service: str, request: Any) -> Any:
    client = node.create_client(kind, service)
    if not client.wait_for_service(TIMEOUT):
        raise UserError(f"no service {service}: {HELP}")
    answer = client.call_async(request)
    rclpy.spin_until_future_complete(node, answer, timeout_sec=TIMEOUT)
    if not answer.done():
        raise UserError(f"{service} does not respond")
    return answer.result()
