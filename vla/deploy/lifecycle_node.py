"""A lifecycle node that survives invalid requests, failed transitions and exceptions in callbacks.

rclpy 7.1 ends the process at a transition that is not available, and swallows exceptions in transitions.
"""

from __future__ import annotations

import traceback
from abc import abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile

from vla.io.errors import UserError

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # late subscribers get the last message
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


def transition(do: Callable[[Any, LifecycleState], Any]) -> Callable[[Any, LifecycleState], TransitionCallbackReturn]:
    """Make a method the callback of a transition, which exceptions refuse; a UserError is logged as one sentence."""

    @wraps(do)
    def tried(node: GuardedLifecycleNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            do(node, state)
        except Exception as error:
            reason = error if isinstance(error, UserError) else traceback.format_exc()
            node.get_logger().error(f"cannot {do.__name__.removeprefix('on_')}: {reason}")
            return FAILURE
        return SUCCESS

    return tried


class GuardedLifecycleNode(LifecycleNode):
    """Base of managed nodes; it registers what they create, so that a cleanup can destroy it."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.created = ExitStack()  # destroys what is added when it is closed, after which more can be added

    @property
    @abstractmethod
    def active(self) -> bool:
        """Whether the node is active."""

    @abstractmethod
    def fail(self, reason: str) -> None:
        """Stop for a reason, such as an unexpected exception in a callback."""

    def add_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        """Subscribe to a topic."""
        subscription = self.create_subscription(kind, topic, self.guard(callback), qos)
        self.created.callback(self.destroy_subscription, subscription)

    def add_publisher(self, kind: type, topic: str, while_active: bool = False, qos: QoSProfile | int = 10) -> Any:
        """Create a publisher that publishes always or only `while_active`."""
        if while_active:
            publisher: Any = self.create_lifecycle_publisher(kind, topic, 1)
            self.created.callback(self.destroy_lifecycle_publisher, publisher)
        else:
            publisher = self.create_publisher(kind, topic, qos)
            self.created.callback(self.destroy_publisher, publisher)
        return publisher

    def add_service(self, kind: Any, name: str, callback: Callable[[Any, Any], Any]) -> None:
        """Create a service."""
        self.created.callback(self.destroy_service, self.create_service(kind, name, callback))

    def guard(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback: an exception stops the arm, not the process."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception:
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)
                self.fail("internal error of the agent, see its log")

        return guarded

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        """Refuse a transition that is not available in this state (ros2/rclpy#1209)."""
        labels = {entry[0]: entry[1] for entry in self._state_machine.available_transitions}
        label, transition_id = request.transition.label, request.transition.id
        if label:
            transition_id = next((key for key, name in labels.items() if name == label), None)
        if transition_id in labels:
            return super()._LifecycleNodeMixin__on_change_state(request, response)  # type: ignore[misc]
        self.get_logger().error(
            f"transition {label or transition_id} is not available, expected one of {', '.join(labels.values())}"
        )
        response.success = False
        return response
