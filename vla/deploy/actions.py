"""Client of the ROS 2 actions of arms and grippers: it sends goals, and checks what the servers answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient

from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.io.errors import UserError

PATIENCE = 5.0  # longest wait for a server at the start [s]
ANSWER = 1.0  # longest time until a server accepts or rejects a goal [s]


@dataclass(eq=False)
class _SentGoal:
    """A goal that was sent."""

    at: float
    handle: Any = None  # once it is accepted
    cancelled: bool = False

    def cancel(self) -> None:
        """Cancel it as soon as it is known to the server."""
        self.cancelled = True
        if self.handle is not None:
            self.handle.cancel_goal_async()


class GoalSender:
    """Sends goals to one action server, where each replaces the one before."""

    def __init__(
        self,
        node: GuardedLifecycleNode,
        kind: Any,
        name: str,
        complaint: Callable[[Any, bool], str],
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        """Send goals of an action class from a node, which fails when the server refuses, gives up or vanishes.

        A `complaint` describes what went wrong from a result and whether another goal has replaced its goal; it may be
        empty. `on_end` is called when the newest goal has ended.
        """
        self.name = node.resolve_topic_name(name)
        self._node, self.kind, self._complaint, self._ended = node, kind, complaint, on_end
        self._client = ActionClient(node, kind, name)
        node.created.callback(self._client.destroy)
        self._goals: list[_SentGoal] = []  # whose results still matter, the newest last
        self._failed = False

    def prepare(self) -> None:
        """Wait for the server, and forget earlier goals and failures; raise a UserError if it does not appear."""
        if not self._client.wait_for_server(PATIENCE):
            kind = f"{self.kind.__module__.partition('.')[0]}/action/{self.kind.__name__}"
            raise UserError(
                f"there is no action server {self.name} of {kind}: is its controller active, and on the same network "
                "and domain?"
            )
        self._goals, self._failed = [], False

    @property
    def active(self) -> bool:
        """True from when a goal is sent until it has ended."""
        return bool(self._goals)

    def send(self, goal: Any) -> None:
        """Send a goal, unless the server has failed."""
        if not self._failed:
            sent_goal = _SentGoal(time.monotonic())
            self._goals.append(sent_goal)
            on_answer = self._node.guard(partial(self._on_answer, sent_goal))
            self._client.send_goal_async(goal).add_done_callback(on_answer)

    def cancel(self) -> None:
        """Cancel the newest goal, if it has not ended."""
        if self._goals and not self._goals[-1].cancelled:
            self._goals[-1].cancel()

    def check(self) -> None:
        """Fail if the server has vanished or does not answer."""
        if self._failed:
            return
        sending_times = [goal.at for goal in self._goals if goal.handle is None]
        if not self._client.server_is_ready():
            self._give_up("has vanished")
        elif sending_times and time.monotonic() - sending_times[0] > ANSWER:
            self._give_up(f"has not answered a goal for {ANSWER:g} s")

    def _give_up(self, problem: str) -> None:
        for goal in self._goals:
            goal.cancel()
        self._goals, self._failed = [], True
        self._node.fail(f"the action server {self.name} {problem}")

    def _on_answer(self, goal: _SentGoal, future: Any) -> None:
        handle, matters = future.result(), goal in self._goals
        if not handle.accepted:
            if matters:
                self._give_up("rejected a goal")
            return
        goal.handle = handle
        if goal.cancelled or not matters:  # in the meantime
            handle.cancel_goal_async()
        if matters:
            handle.get_result_async().add_done_callback(self._node.guard(partial(self._on_result, goal)))

    def _on_result(self, goal: _SentGoal, future: Any) -> None:
        if goal not in self._goals:
            return
        answer, is_newest = future.result(), goal is self._goals[-1]
        self._goals.remove(goal)
        done = answer.status == GoalStatus.STATUS_SUCCEEDED or (is_newest and goal.cancelled)
        if not done and (complaint := self._complaint(answer.result, not is_newest)):
            verb = "cancelled" if answer.status == GoalStatus.STATUS_CANCELED else "aborted"
            self._give_up(f"{verb} a goal: {complaint}")
        elif is_newest:
            self._ended()
