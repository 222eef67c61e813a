"""Client of the ROS 2 actions of arms and grippers: it sends goals, and checks what the servers answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus

from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.io.errors import UserError

PATIENCE = 5.0  # longest wait for a server at the start [s]
ANSWER = 1.0  # longest time until a server accepts or rejects a goal [s]


@dataclass(eq=False)
class _Sent:
    """A goal that was sent."""

    at: float
    handle: Any = None  # once it is accepted
    over: bool = False  # it has ended, or its result no longer matters
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
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Args:
        node: sends the goals, and fails with one sentence when the server refuses, gives up or vanishes.
        kind: class of the action.
        name: of the server.
        complaint: describes what went wrong from a result and whether another goal has replaced its goal; may be empty.
        ended: called when the newest goal has ended.
        """
        self.name = node.resolve_topic_name(name)
        self._node, self.kind, self._complaint, self._ended = node, kind, complaint, ended
        self._client = node.add_action_client(kind, name)
        self._goals: list[_Sent] = []  # that have not ended, the newest last
        self._failed = False

    def prepare(self) -> None:
        """Wait for the server, and forget earlier goals and failures; raise a UserError if it does not appear."""
        if not self._client.wait_for_server(PATIENCE):
            kind = f"{self.kind.__module__.partition('.')[0]}/action/{self.kind.__name__}"
            raise UserError(
                f"there is no action server {self.name} of {kind}: is its controller active, and on the same network "
                "and domain?"
            )
        self._forget()
        self._failed = False

    @property
    def active(self) -> bool:
        """True from when a goal is sent until it has ended."""
        return bool(self._goals)

    def send(self, goal: Any) -> None:
        """Send a goal, unless the server has failed."""
        if not self._failed:
            sent = _Sent(time.monotonic())
            self._goals.append(sent)
            answered = self._node.guard(partial(self._on_answer, sent))
            self._client.send_goal_async(goal).add_done_callback(answered)

    def cancel(self) -> None:
        """Cancel the newest goal, if it has not ended."""
        if self._goals and not self._goals[-1].cancelled:
            self._goals[-1].cancel()

    def check(self) -> None:
        """Fail if the server has vanished or does not answer."""
        if self._failed:
            return
        unanswered = [sent.at for sent in self._goals if sent.handle is None]
        if not self._client.server_is_ready():
            self._give_up("has vanished")
        elif unanswered and time.monotonic() - unanswered[0] > ANSWER:
            self._give_up(f"has not answered a goal for {ANSWER:g} s")

    def _forget(self) -> None:
        for sent in self._goals:
            sent.over = True
        self._goals = []

    def _give_up(self, what: str) -> None:
        for sent in self._goals:
            sent.cancel()
        self._forget()
        self._failed = True
        self._node.fail(f"the action server {self.name} {what}")

    def _on_answer(self, sent: _Sent, future: Any) -> None:
        handle = future.result()
        if not handle.accepted:
            if not sent.over:
                self._give_up("rejected a goal")
            return
        sent.handle = handle
        if sent.over or sent.cancelled:  # in the meantime
            handle.cancel_goal_async()
        if not sent.over:
            handle.get_result_async().add_done_callback(self._node.guard(partial(self._on_result, sent)))

    def _on_result(self, sent: _Sent, future: Any) -> None:
        if sent.over:
            return
        answer, newest = future.result(), sent is self._goals[-1]
        self._goals.remove(sent)
        sent.over = True
        done = answer.status == GoalStatus.STATUS_SUCCEEDED or (newest and sent.cancelled)
        if not done and (complaint := self._complaint(answer.result, not newest)):
            what = "cancelled" if answer.status == GoalStatus.STATUS_CANCELED else "aborted"
            self._give_up(f"{what} a goal: {complaint}")
        elif newest:
            self._ended()
