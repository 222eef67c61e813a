"""The simulated arm as a ROS 2 node, behind the topics of a real one, which can take its place unchanged."""

from __future__ import annotations

import json
import time
from collections import deque
from functools import partial
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from vla.deploy import messages
from vla.deploy.governor import Robot
from vla.deploy.ros2 import Timing, Topics
from vla.spec import LONGEST_INSTRUCTION, Array
from vla.tasks.control import MAX_OPENING
from vla.tasks.tabletop import Tabletop


class Simulator(Node):
    """Plays episodes one after the other: `~/reset` starts the next, `~/episode` and the log say how it stands.

    An episode's time runs from the first instruction that is heard, as in evaluation.
    """

    def __init__(self, environment: Tabletop, robot: Robot, topics: Topics, timing: Timing, seed: int) -> None:
        super().__init__("vla_simulator")
        self.environment, self.robot, self.timing, self.seed = environment, robot, timing, seed - 1
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        qos = QoSProfile(depth=1)
        self._images = {
            camera: self.create_publisher(Image, topics.images[camera], qos) for camera in environment.spec.cameras
        }
        self._joints = self.create_publisher(JointState, topics.joint_states, qos)
        lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._episode = self.create_publisher(String, "~/episode", lasting)
        self._world_clock = self.create_publisher(ClockMessage, "/clock", qos) if timing.clock else None
        self.create_subscription(JointState, topics.commands, self._on_command, qos)
        self.create_subscription(String, topics.instruction, self._on_instruction, qos)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._late: deque[tuple[float, Any]] = deque()  # publications that wait for their latency
        self._elapsed = 0.0  # simulated time since the start [s]
        self.reset()
        self._tick_seconds = 1 / timing.joints_hz
        self.create_timer(self._tick_seconds / timing.speed, self._tick, clock=self._steady)

    def reset(self) -> None:
        """Begin the next episode."""
        self.seed += 1
        self.environment.reset(self.seed)
        self._heard_at: float | None
        self._target, self._heard_at = self._here(), None
        self._running, self._ticks = False, 0
        self._until_frame = 0.0
        self.get_logger().info(self.words)
        self._tell()

    @property
    def words(self) -> str:
        """The episode in words: its seed and what to say."""
        return f'episode {self.seed}: "{self.environment.task.instruction}"'

    def _on_reset(self, request: Any, response: Any) -> Any:
        self.reset()
        response.success, response.message = True, self.words
        return response

    def _on_instruction(self, message: String) -> None:
        heard = len(message.data) <= LONGEST_INSTRUCTION and message.data.strip()
        if heard and not self._running and not self.environment.done:
            self._running, self._ticks = True, 0

    def _on_command(self, message: JointState) -> None:
        try:
            joints, opening = messages.command_from(message, self.robot)
        except ValueError as error:
            return self.get_logger().warning(messages.cut(str(error), 300), throttle_duration_sec=1.0)
        self._target = (joints, self._target[1] if opening is None else opening)
        self._heard_at = time.monotonic()

    def _tick(self) -> None:
        """One stretch of simulated time, then what sensors say after it."""
        silent = self._heard_at is None or time.monotonic() - self._heard_at > self.timing.command_timeout
        if silent and self._heard_at is not None:
            self.get_logger().warning("no commands: the arm stays where it is", throttle_duration_sec=5.0)
            self._target, self._heard_at = self._here(), None
        self.environment.drive(*self._target, self._tick_seconds)
        self._elapsed += self._tick_seconds
        self._ticks += 1
        period = 1 / self.environment.spec.control_hz
        if self._running and self._ticks % round(period / self._tick_seconds) == 0:
            self.environment.judge()
            if self.environment.done:
                self._running = False
                after = "in" if self.environment.outcome == "success" else "after"
                self.get_logger().info(f"{self.environment.outcome} {after} {self._ticks * self._tick_seconds:.1f} s")
                self._tell()
        self._publish()

    def _publish(self) -> None:
        stamp = self._now()
        if self._world_clock is not None:
            self._world_clock.publish(ClockMessage(clock=stamp))
        joints, velocities, opening = self.environment.posture()
        fingers = len(self.robot.fingers)
        message = JointState(name=[*self.robot.joints, *self.robot.fingers])
        message.position = [*joints.tolist(), *[opening / max(fingers, 1)] * fingers]
        message.velocity = [*velocities.tolist(), *[0.0] * fingers]
        message.header.stamp = stamp
        self._joints.publish(message)
        self._until_frame -= self._tick_seconds
        if self._until_frame <= 1e-9:
            self._until_frame += 1 / self.timing.camera_hz
            due = time.monotonic() + self.timing.camera_latency
            for camera, image in self.environment.look().rgb.items():
                frame = messages.fill_image(Image(), image, f"{camera}_camera_optical_frame")
                frame.header.stamp = stamp
                self._late.append((due, partial(self._images[camera].publish, frame)))
        while self._late and self._late[0][0] <= time.monotonic():
            self._late.popleft()[1]()

    def _here(self) -> tuple[Array, float]:
        """The command that leaves everything where it is: joints [rad] and opening 0 … 1."""
        joints, _, opening = self.environment.posture()
        return joints.astype(float), opening / MAX_OPENING

    def _now(self) -> Any:
        """The stamp of a measurement that is made now."""
        if self.timing.clock:
            return Time(nanoseconds=int(self._elapsed * 1e9)).to_msg()
        return self.get_clock().now().to_msg()

    def _tell(self) -> None:
        environment = self.environment
        what = {
            "seed": self.seed,
            "instruction": environment.task.instruction,
            "done": environment.done,
            "outcome": environment.outcome,
        }
        self._episode.publish(String(data=json.dumps(what)))
