"""A lifecycle node that survives: wrong requests, transitions that fail and bugs in callbacks.

rclpy 7.1 ends the process at a transition that the state does not have, and swallows what transitions raise.
"""

from __future__ import annotations

import traceback
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile

DONE, NOT_DONE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Managed(LifecycleNode):
    """What the transitions do is up to subclasses; what `subscribe`, `publish` and `serve` make lasts until cleanup."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._made: list[tuple[Callable[[Any], Any], Any]] = []

    @abstractmethod
    def configure(self) -> None:
        """Get ready; a ValueError refuses, in words."""

    @abstractmethod
    def activate(self) -> None:
        """Begin; a ValueError refuses, in words."""

    @abstractmethod
    def come_to_rest(self) -> None:
        """End what `activate` began, if it did."""

    @abstractmethod
    def clean_up(self) -> None:
        """Undo `configure`."""

    @abstractmethod
    def broken(self, reason: str) -> None:
        """A callback raised what it should not have."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See `configure`."""
        return self._try("configure", self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See `activate`."""
        result = self._try("activate", self.activate)
        return super().on_activate(state) if result is DONE else result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See `come_to_rest`, which publishes before the publishers fall silent."""
        result = self._try("deactivate", self.come_to_rest)
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See `clean_up`."""
        return self._try("clean up", self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Both of the last two."""
        self._try("come to rest", self.come_to_rest)
        return self._try("clean up", self._clean_up)

    def subscribe(self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        """Listen to a topic."""
        subscription = self.create_subscription(kind, topic, self.guard(callback), qos)
        self._made.append((self.destroy_subscription, subscription))

    def publish(self, kind: type, topic: str, while_active: bool = False) -> Any:
        """A publisher; one that speaks only `while_active`, or always."""
        create = self.create_lifecycle_publisher if while_active else super(LifecycleNode, self).create_publisher
        publisher = create(kind, topic, 1 if while_active else 10)
        self._made.append((self.destroy_publisher, publisher))
        return publisher

    def serve(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service."""
        self._made.append((self.destroy_service, self.create_service(kind, name, answer)))

    def guard(self, callback: Callable[..., None]) -> Callable[..., None]:
        """A callback whose bugs stop the arm, not the process that can stop it."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception:
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)
                self.broken("a bug in the agent, see its log")

        return guarded

    def _clean_up(self) -> None:
        self.clean_up()
        for destroy, thing in self._made:
            destroy(thing)
        self._made = []

    def _try(self, what: str, do: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            do()
        except ValueError as error:
            self.get_logger().error(f"cannot {what}: {error}")
            return NOT_DONE
        except Exception:
            self.get_logger().error(f"cannot {what}: {traceback.format_exc()}")
            return NOT_DONE
        return DONE

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        """Refuse a transition that the state does not have (ros2/rclpy#1209)."""
        known = {transition[0]: transition[1] for transition in self._state_machine.available_transitions}
        label = request.transition.label
        wanted = next((key for key, name in known.items() if name == label), None) if label else request.transition.id
        if wanted not in known:
            self.get_logger().error(f"there is no transition {label or wanted} now, only {', '.join(known.values())}")
            response.success = False
            return response
        return super()._LifecycleNodeMixin__on_change_state(request, response)  # type: ignore[misc]
