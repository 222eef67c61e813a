"""Inputs of the policy node: images, joint states and instructions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import String

from vla.deploy import messages
from vla.deploy.control_loop import ControlLoop
from vla.deploy.diagnostics import Diagnostics
from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.deploy.observer import MAX_CLOCK_ERROR, MAX_STAMP_AGE
from vla.deploy.safety import clock
from vla.deploy.settings import COMPRESSED, PolicySettings
from vla.io.errors import UserError
from vla.spec import LONGEST_INSTRUCTION

INSTRUCTIONS = 100  # that may wait while the node is busy


class Inputs:
    """Subscriptions that feed a control loop while the node is active, and drop what cannot be used."""

    def __init__(
        self,
        node: GuardedLifecycleNode,
        loop: ControlLoop,
        settings: PolicySettings,
        diagnostics: Diagnostics,
        advance: Callable[[], None],
    ) -> None:
        """Args: the node; its loop, settings and diagnostics; `advance` is called after an image."""
        self._node, self._loop, self._diagnostics, self._advance = node, loop, diagnostics, advance
        self._joint_states = messages.JointStates(loop.limits)
        self._stamps: dict[str, tuple[int, int]] = {}  # source → its last time stamp
        self._synchronised: set[str] = set()  # sources that once had the clock of this node
        topics = settings.topics
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # matches every publisher
        for camera in loop.spec.cameras:
            topic_name = node.resolve_topic_name(topics.images[camera])
            kind = CompressedImage if topic_name.endswith(COMPRESSED) else Image
            node.add_subscription(kind, topics.images[camera], partial(self._on_image, camera), best_effort)
        for topic in filter(None, {topics.joint_states, topics.finger_states}):
            node.add_subscription(JointState, topic, self._on_joint_state, best_effort)
        # None replaces another: one that stops the arm might be followed at once by one of somebody else.
        node.add_subscription(String, topics.instruction, self._on_instruction, QoSProfile(depth=INSTRUCTIONS))

    def _on_image(self, camera: str, message: Any) -> None:
        if not self._node.active:
            return
        now = clock()
        try:
            age = self._age(camera, message)  # first, because decoding takes time
            image = messages.image_from(message)
        except UserError as error:
            return self._diagnostics.drop(f"camera {camera}: {error}")
        self._diagnostics.record("image age", age)
        self._loop.observer.add_image(camera, image, now - age)
        self._advance()

    def _age(self, source: str, message: Any) -> float:
        """Return the age of a message [s] by its time stamp, 0 if that is of another clock. Raises a UserError if the
        clock is frozen or ahead of this one, as its messages would seem younger than they are, or the message is older
        than `MAX_STAMP_AGE` although the clock was once that of this node."""
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        if stamp == (0, 0):
            return 0.0
        if stamp == self._stamps.get(source):
            raise UserError("two messages have the same time stamp: is its clock frozen?")
        self._stamps[source] = stamp
        age = self._node.get_clock().now().nanoseconds * 1e-9 - (stamp[0] + stamp[1] * 1e-9)
        if age >= MAX_STAMP_AGE and source in self._synchronised:
            raise UserError(f"its time stamp is {age:.0f} s old")
        if age < -MAX_CLOCK_ERROR and (age > -MAX_STAMP_AGE or source in self._synchronised):
            raise UserError(f"its time stamp is {-age:.2f} s in the future: synchronise the clocks")
        if not 0 <= age < MAX_STAMP_AGE:
            return 0.0
        self._synchronised.add(source)
        return age

    def _on_joint_state(self, message: JointState) -> None:
        now = clock()
        if not self._node.active:
            return
        try:
            has_arm = not {*message.name}.isdisjoint(self._loop.limits.joints)
            age = self._age("arm" if has_arm else "fingers", message)
            joint_state = self._joint_states.read(message, now - age)
        except UserError as error:
            return self._diagnostics.drop(f"joint states: {error}")
        if joint_state is not None:
            self._loop.observer.add_joint_state(joint_state)

    def _on_instruction(self, message: String) -> None:
        if not self._node.active:
            return
        instruction, loop = message.data.strip(), self._loop
        quotation = repr(messages.shorten(message.data))
        if (length := len(message.data)) > LONGEST_INSTRUCTION:
            limit = f"an instruction of {length} characters, the limit is {LONGEST_INSTRUCTION}: {quotation}"
            return self._diagnostics.drop(limit)
        is_repetition = instruction == loop.instruction
        if loop.on_instruction(instruction, clock()):
            if not is_repetition:
                self._node.get_logger().info(f"instruction: {quotation}")
        elif instruction:
            self._diagnostics.ignore(f"instruction ignored while {loop.state}: {quotation}; {loop.reason}")
