"""Subscriptions to every topic of the network, including topics that appear later."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import Any

PRIVATE = ("/rosout", "/parameter_events")  # of ROS itself
DISCOVERY_PERIOD = 0.5  # between two queries for new topics [s]
MESSAGE_PACKAGES = ("sensor_msgs", "std_msgs", "trajectory_msgs", "geometry_msgs", "diagnostic_msgs", "rosgraph_msgs")


def message_class(name: str) -> Any:
    """Return the class of a message type such as sensor_msgs/msg/Image; None outside `MESSAGE_PACKAGES`."""
    package, _, kind = name.partition("/msg/")
    found = getattr(import_module(f"{package}.msg"), kind, None) if package in MESSAGE_PACKAGES else None
    return found if isinstance(found, type) else None


class TopicListener(ABC):
    """Subscribes to every topic of a node's network until `close`."""

    raw = False  # True: messages are passed as bytes

    def __init__(self, node: Any) -> None:
        """Args: the node that subscribes, which the caller spins."""
        self.node, self._known = node, set(PRIVATE)
        self._subscriptions: list[Any] = []
        self._discover()
        self._timer = node.create_timer(DISCOVERY_PERIOD, self._discover)

    @abstractmethod
    def callback_for(self, topic: str, kind: str) -> Callable[[Any], None] | None:
        """Return the callback for a topic of type `kind`, or None to ignore the topic."""

    def close(self) -> None:
        """Destroy the subscriptions."""
        self.node.destroy_timer(self._timer)
        for subscription in self._subscriptions:
            self.node.destroy_subscription(subscription)

    def _discover(self) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)  # matches every publisher
        latched = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # also what was published before

        for topic, kinds in self.node.get_topic_names_and_types():
            message = message_class(kinds[0]) if topic not in self._known else None
            self._known.add(topic)
            callback = self.callback_for(topic, kinds[0]) if message is not None else None
            if callback is None:
                continue
            offered = [info.qos_profile for info in self.node.get_publishers_info_by_topic(topic)]
            all_latched = {(each.durability, each.reliability) for each in offered} == {
                (latched.durability, latched.reliability)
            }
            qos = latched if all_latched else best_effort
            self._subscriptions.append(self.node.create_subscription(message, topic, callback, qos, raw=self.raw))
