"""Goals of the ROS 2 actions that arms and grippers listen to, and what their servers say about them."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus

from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.io.errors import UserError

PATIENCE = 5.0  # longest wait for a server at the start [s]
ANSWER = 1.0  # longest time until a server accepts or rejects a goal [s]


class GoalSender:
    """Sends goals to one action server, where each replaces the one before."""

    def __init__(
        self,
        node: GuardedLifecycleNode,
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
        self._client = node.add_action_client(kind, name)
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
