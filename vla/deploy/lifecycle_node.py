"""A lifecycle node that survives invalid requests, failed transitions and exceptions in callbacks.

rclpy 7.1 ends the process at a transition that is not available, and swallows exceptions in transitions.
"""

from __future__ import annotations

import traceback
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class GuardedLifecycleNode(LifecycleNode):
    """Base of managed nodes; destroys the subscriptions, publishers and services that it created on cleanup."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._created: list[tuple[Callable[[Any], Any], Any]] = []

    @abstractmethod
    def configure(self) -> None:
        """Prepare; a UserError refuses the transition."""

    @abstractmethod
    def activate(self) -> None:
        """Start; a UserError refuses the transition."""

    @abstractmethod
    def brake(self) -> None:
        """Bring the arm to rest and undo `activate`; does nothing if the node is inactive."""

    @abstractmethod
    def clean_up(self) -> None:
        """Undo `configure`."""

    @abstractmethod
    def on_callback_error(self, reason: str) -> None:
        """Handle an unexpected exception in a callback."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `configure`."""
        return self._try("configure", self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `activate`."""
        result = self._try("activate", self.activate)
        return super().on_activate(state) if result is SUCCESS else result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `brake` while the publishers are still active."""
        result = self._try("deactivate", self.brake)
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `clean_up`."""
        return self._try("clean up", self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `brake` and `clean_up`."""
        self._try("brake", self.brake)
        return self._try("clean up", self._clean_up)

    def add_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        """Subscribe to a topic."""
        subscription = self.create_subscription(kind, topic, self.guard(callback), qos)
        self._created.append((self.destroy_subscription, subscription))

    def add_publisher(self, kind: type, topic: str, while_active: bool = False) -> Any:
        """Create a publisher that publishes always or only `while_active`."""
        create = self.create_lifecycle_publisher if while_active else super(LifecycleNode, self).create_publisher
        publisher = create(kind, topic, 1 if while_active else 10)
        destroy = self.destroy_lifecycle_publisher if while_active else self.destroy_publisher
        self._created.append((destroy, publisher))
        return publisher

    def add_service(self, kind: Any, name: str, callback: Callable[[Any, Any], Any]) -> None:
        """Create a service."""
        self._created.append((self.destroy_service, self.create_service(kind, name, callback)))

    def guard(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback: an exception stops the arm, not the process."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception:
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)
                self.on_callback_error("internal error of the agent, see its log")

        return guarded

    def _clean_up(self) -> None:
        self.clean_up()
        for destroy, entity in self._created:
            destroy(entity)
        self._created = []

    def _try(self, what: str, do: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            do()
        except ValueError as error:
            self.get_logger().error(f"cannot {what}: {error}")
            return FAILURE
        except Exception:
            self.get_logger().error(f"cannot {what}: {traceback.format_exc()}")
            return FAILURE
        return SUCCESS

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        """Refuse a transition that is not available in this state (ros2/rclpy#1209)."""
        available = {transition[0]: transition[1] for transition in self._state_machine.available_transitions}
        label = request.transition.label
        wanted = (
            next((key for key, name in available.items() if name == label), None) if label else request.transition.id
        )
        if wanted not in available:
            self.get_logger().error(
                f"transition {label or wanted} is not available, expected one of {', '.join(available.values())}"
            )
            response.success = False
            return response
        return super()._LifecycleNodeMixin__on_change_state(request, response)  # type: ignore[misc]
