"""Diagnostics of the policy node: its state, latencies and dropped messages."""

from __future__ import annotations

from collections import deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, QoSProfile

from vla.deploy.control_loop import ControlLoop
from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.deploy.messages import HANDED_OVER, shorten
from vla.deploy.safety import State

LEVELS = dict.fromkeys((State.HOLDING, State.STOPPED), DiagnosticStatus.WARN) | {State.FAULT: DiagnosticStatus.ERROR}
RECENT_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # also for late subscribers
MAX_MESSAGE = 300  # length of a log line or status message [characters]


class Diagnostics:
    """Publishes ~/status and /diagnostics, and logs what changes."""

    def __init__(self, node: GuardedLifecycleNode, loop: ControlLoop, dry_run: bool) -> None:
        self._node, self._loop, self._dry_run, self._drop_count = node, loop, dry_run, 0
        self._status = node.add_publisher(DiagnosticStatus, "~/status", qos=RECENT_QOS)
        self._array = node.add_publisher(DiagnosticArray, "/diagnostics")
        self._latencies: dict[str, deque[float]] = {}
        self._reported_state: tuple[State | None, str] = (None, "")
        self._ignored_message = ""  # message about an instruction that is ignored after a stop or a fault

    def record(self, name: str, seconds: float) -> None:
        """Add a latency."""
        self._latencies.setdefault(name, deque(maxlen=500)).append(seconds)

    def drop(self, reason: str) -> None:
        """Count a message that cannot be used."""
        self._drop_count += 1
        self._node.get_logger().warning(shorten(reason, MAX_MESSAGE), throttle_duration_sec=1.0)

    def ignore(self, message: str) -> None:
        """Report that an instruction is ignored, once until the state changes."""
        if message != self._ignored_message:
            self._ignored_message = message
            self._node.get_logger().warning(shorten(message, MAX_MESSAGE))
            self.report()

    def report_changes(self) -> None:
        """Report if state or reason have changed."""
        if (self._loop.state, self._loop.reason) != self._reported_state:
            self.report()

    def report(self) -> None:
        """Publish the status, and log a changed state."""
        loop, level = self._loop, LEVELS.get(self._loop.state, DiagnosticStatus.OK)
        if (loop.state, loop.reason) != self._reported_state:
            self._reported_state, self._ignored_message = (loop.state, loop.reason), ""
            line = f"{loop.state}: {shorten(loop.reason, MAX_MESSAGE)}".removesuffix(": ")
            # Two calls, because rclpy refuses to log with changing severity from one line.
            if level == DiagnosticStatus.OK:
                self._node.get_logger().info(line)
            else:
                self._node.get_logger().warning(line)
        pairs = [KeyValue(key=key, value=value) for key, value in self._values().items()]
        text = shorten(self._ignored_message or loop.reason or loop.state.value, MAX_MESSAGE)
        status = DiagnosticStatus(level=level, name=self._node.get_name(), message=text, values=pairs)
        self._status.publish(status)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._array.publish(array)

    def _values(self) -> dict[str, str]:
        loop = self._loop
        values = {
            "state": loop.state.value,
            HANDED_OVER: "yes" if loop.handed_over or self._dry_run else "no",
            "instruction": shorten(loop.instruction),
            "messages dropped": str(self._drop_count),
            "late plans": str(loop.late_plans),
        }
        for name, seconds in self._latencies.items():
            middle, high = np.percentile(list(seconds), [50, 99]) * 1000
            values |= {f"{name} p50 [ms]": f"{middle:.1f}", f"{name} p99 [ms]": f"{high:.1f}"}
        return values
