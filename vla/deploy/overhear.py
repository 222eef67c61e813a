"""Hearing every topic of the network, also those that come later."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import Any

PRIVATE = ("/rosout", "/parameter_events")  # of ROS itself
LOOK_AROUND = 0.5  # how often new topics are looked for [s]
MESSAGE_PACKAGES = ("sensor_msgs", "std_msgs", "trajectory_msgs", "diagnostic_msgs", "rosgraph_msgs")


def message_class(name: str) -> Any:
    """The class of a message type such as sensor_msgs/msg/Image; None for those that robots and agents do not use."""
    package, _, kind = name.partition("/msg/")
    found = getattr(import_module(f"{package}.msg"), kind, None) if package in MESSAGE_PACKAGES else None
    return found if isinstance(found, type) else None


class Eavesdropper(ABC):
    """Subscribes to every topic of a node's network; ends with `close`."""

    raw = False  # whether messages come as bytes

    def __init__(self, node: Any) -> None:
        """Args: the node whose spinning listens."""
        self.node, self._known = node, set(PRIVATE)
        self._subscriptions: list[Any] = []
        self._look_around()
        self._timer = node.create_timer(LOOK_AROUND, self._look_around)

    @abstractmethod
    def hearer(self, topic: str, kind: str) -> Callable[[Any], None] | None:
        """What to do with the messages of a topic, whose type is `kind`; None does not listen."""

    def close(self) -> None:
        """Stop listening."""
        self.node.destroy_timer(self._timer)
        for subscription in self._subscriptions:
            self.node.destroy_subscription(subscription)

    def _look_around(self) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        for topic, kinds in self.node.get_topic_names_and_types():
            message = message_class(kinds[0]) if topic not in self._known else None
            self._known.add(topic)
            hear = self.hearer(topic, kinds[0]) if message is not None else None
            if hear is None:
                continue
            qos = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)  # which hears everybody
            self._subscriptions.append(self.node.create_subscription(message, topic, hear, qos, raw=self.raw))
