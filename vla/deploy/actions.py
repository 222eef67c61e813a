"""Goals of the ROS 2 actions that arms and grippers listen to, and what their servers say about them."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient

from vla.deploy.ros import action_class
from vla.deploy.settings import FrankaGripper, GripperCommand
from vla.io.errors import UserError

PATIENCE = 5.0  # longest wait for a server at the start [s]
ANSWER = 1.0  # longest time until a server accepts or rejects a goal [s]
CLOSE_BELOW, OPEN_ABOVE = 0.4, 0.6  # commanded opening of a gripper at which its goal changes
CODES = {
    0: "SUCCESSFUL",
    -1: "INVALID_GOAL",
    -2: "INVALID_JOINTS",
    -3: "OLD_HEADER_TIMESTAMP",
    -4: "PATH_TOLERANCE_VIOLATED",
    -5: "GOAL_TOLERANCE_VIOLATED",
}  # of control_msgs/action/FollowJointTrajectory
REPLACED = (0, -1)  # codes of a goal that another one has replaced


class GoalSender:
    """Sends goals to one action server, where each replaces the one before."""

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        complaint: Callable[[Any, bool], str],
        fail: Callable[[str], None],
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Args:
        node: sends the goals; its guard wraps the callbacks.
        kind: class of the action.
        name: of the server.
        complaint: describes what went wrong from a result and whether another goal has replaced its goal; may be empty.
        fail: called with one sentence when the server refuses, gives up or vanishes.
        ended: called when the newest goal has ended.
        """
        self.name = node.resolve_topic_name(name)
        self._node, self.kind, self._complaint, self._fail, self._ended = node, kind, complaint, fail, ended
        self._client = ActionClient(node, kind, name)
        self._newest = 0  # number of the newest goal
        self.reset()

    def reset(self) -> None:
        """Reset the state of the goals; what becomes of those sent so far no longer counts."""
        self._newest += 1
        self._first = self._newest + 1  # number of the first goal that counts
        self._handle: Any = None  # of the newest goal that was accepted and has not ended
        self._unanswered: dict[int, float] = {}  # number of a goal → when it was sent
        self._cancelled = self._rejected = self._given_up = False

    def require_server(self) -> None:
        """Raise a UserError if the server does not show up."""
        if not self._client.wait_for_server(PATIENCE):
            kind = f"{self.kind.__module__.partition('.')[0]}/action/{self.kind.__name__}"
            raise UserError(
                f"there is no action server {self.name} of {kind}: is its controller active, and on the same network "
                "and domain?"
            )

    @property
    def active(self) -> bool:
        """True from when a goal is sent until it has ended."""
        return self._newest in self._unanswered or self._handle is not None

    def send(self, goal: Any) -> None:
        """Send a goal, unless the server has failed."""
        if self._given_up:
            return
        self._newest += 1
        self._unanswered[self._newest], self._cancelled = time.monotonic(), False
        answered = self._node.guard(partial(self._on_answer, self._newest))
        self._client.send_goal_async(goal).add_done_callback(answered)

    def cancel(self) -> None:
        """Cancel the newest goal as soon as it is known to the server, if it has not ended by then."""
        if self.active and not self._cancelled:
            self._cancelled = True
            if self._newest not in self._unanswered:
                self._handle.cancel_goal_async()

    def check(self) -> None:
        """Fail if the server has vanished or does not answer."""
        if self._given_up:
            return
        if not self._client.server_is_ready():
            self._give_up("has vanished")
        elif self._unanswered and time.monotonic() - min(self._unanswered.values()) > ANSWER:
            self._give_up(f"has not answered a goal for {ANSWER:g} s")

    def destroy(self) -> None:
        """Destroy the client."""
        self._client.destroy()

    def _give_up(self, what: str) -> None:
        if self._handle is not None:
            self._handle.cancel_goal_async()
        self._given_up, self._handle, self._unanswered = True, None, {}
        self._fail(f"the action server {self.name} {what}")

    def _on_answer(self, number: int, future: Any) -> None:
        handle, newest = future.result(), number == self._newest
        self._unanswered.pop(number, None)
        if not handle.accepted:
            return self._on_rejection() if newest and not self._given_up else None
        if self._given_up or number < self._first:  # accepted too late
            handle.cancel_goal_async()
            return None
        handle.get_result_async().add_done_callback(self._node.guard(partial(self._on_result, number)))
        if newest:
            self._handle, self._rejected = handle, False
            if self._cancelled:
                handle.cancel_goal_async()

    def _on_rejection(self) -> None:
        """Let a second goal follow, which brakes; if that is rejected too, cancel what the server still executes."""
        if not self._rejected:
            self._rejected = True
            return self._fail(f"the action server {self.name} rejected a goal")
        self._given_up = True
        if self._handle is not None:
            self._handle.cancel_goal_async()

    def _on_result(self, number: int, future: Any) -> None:
        if number < self._first:
            return
        answer, newest = future.result(), number == self._newest
        if newest:
            self._handle = None
        done = answer.status == GoalStatus.STATUS_SUCCEEDED or (newest and self._cancelled)
        if not (done or self._given_up) and (complaint := self._complaint(answer.result, not newest)):
            what = "cancelled" if answer.status == GoalStatus.STATUS_CANCELED else "aborted"
            return self._give_up(f"{what} a goal: {complaint}")
        if newest:
            self._ended()


def trajectory_complaint(result: Any, replaced: bool) -> str:
    """Describe a result of FollowJointTrajectory; empty if its goal was replaced and that is all."""
    code = result.error_code
    if replaced and code in REPLACED:
        return ""
    return ", ".join(filter(None, (CODES.get(code, f"error code {code}"), result.error_string)))


class GripperGoals:
    """Opens and closes a gripper: one goal at a time, and another one only when the commanded state changes."""

    def __init__(
        self,
        node: Any,
        settings: GripperCommand | FrankaGripper,
        server: str,
        fail: Callable[[str], None],
    ) -> None:
        """Args: the node; settings of the gripper; name of its action server; `fail` as in `GoalSender`.

        Raises:
            UserError: a package of messages is not installed.
        """

        def sender(kind: Any, name: str, complaint: Callable[[Any, bool], str]) -> GoalSender:
            return GoalSender(node, kind, name, complaint, fail, self._advance)

        if isinstance(settings, FrankaGripper):
            grasp, move = (action_class(*names) for names in settings.actions)
            speed, force = float(settings.speed), float(settings.force)  # YAML may hold whole numbers
            opening = move.Goal(width=float(settings.open), speed=speed)
            closing = grasp.Goal(width=float(settings.closed), speed=speed, force=force)
            closing.epsilon.inner, closing.epsilon.outer = map(float, settings.epsilon)
            # A missed grasp has an empty error text, so only errors of the driver count.
            missed = sender(grasp, f"{server}/grasp", lambda result, _: result.error)
            stuck = sender(move, f"{server}/move", lambda result, _: result.error or "it does not reach its width")
            self._goals = {True: (stuck, opening), False: (missed, closing)}
        else:
            kind = action_class(*settings.actions[0])
            # A stalled gripper has grasped something, which is no error.
            only = sender(kind, server, lambda result, _: "" if result.stalled else "it does not reach its position")
            self._goals = {wanted: (only, kind.Goal()) for wanted in (True, False)}
            for wanted, position in ((True, settings.open), (False, settings.closed)):
                command = self._goals[wanted][1].command
                command.position, command.max_effort = float(position), float(settings.effort)
        self.senders = {sender.name: sender for sender, _ in self._goals.values()}
        self.reset()

    def reset(self) -> None:
        """Reset the state: the next opening is sent even if it repeats the last."""
        self._wanted: bool | None = None  # open?
        self._sent: bool | None = None

    def command(self, opening: float) -> None:
        """Open above `OPEN_ABOVE`, close below `CLOSE_BELOW`; `opening` is 0 closed … 1 open."""
        if opening > OPEN_ABOVE:
            self._wanted = True
        elif opening < CLOSE_BELOW:
            self._wanted = False
        self._advance()

    def hold(self) -> None:
        """Send nothing until the next command; drop a goal that waits for the cancellation of the previous one."""
        self._wanted = None

    def _advance(self) -> None:
        """Send the requested goal once the previous one has ended: Franka's gripper accepts one at a time."""
        if self._wanted is None or self._wanted == self._sent:
            return
        busy = [sender for sender in self.senders.values() if sender.active]
        for sender in busy:
            sender.cancel()
            self._sent = None
        if not busy:
            sender, goal = self._goals[self._wanted]
            self._sent = self._wanted
            sender.send(goal)
