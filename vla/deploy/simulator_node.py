"""The simulated arm as a ROS 2 node with the topics of a real one."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from vla.deploy import messages
from vla.deploy.lifecycle_node import LATCHED_QOS
from vla.deploy.messages import SimulatedEpisode
from vla.deploy.settings import SimulatorSettings
from vla.io.errors import UserError
from vla.spec import LONGEST_INSTRUCTION, Array, Environment, TakesJointTargets


class SimulatorNode(Node):
    """Plays episodes one after the other: `~/reset` starts the next, `~/episode` and the log give its status.

    The time of an episode starts with the first instruction, as in evaluation.
    """

    def __init__(self, environment: Environment, settings: SimulatorSettings) -> None:
        """Args: an environment that `TakesJointTargets`; the settings.

        Raises:
            UserError: the environment has no robot, or another one than the settings, is not `TakesJointTargets`, or
                gives several instructions in a row, a control step is not a whole number of ticks, or a camera has no
                topic.
        """
        rates, topics, limits = (settings.joints_hz, settings.camera_hz), settings.topics, settings.robot
        self._model = environment.spec.require_robot("deploy=simulator")
        if not isinstance(environment, TakesJointTargets):
            raise UserError(
                f"deploy=simulator needs TakesJointTargets, such as task=tabletop: {type(environment).__name__} is none"
            )
        limits.require(self._model, "the task")
        control_hz = environment.spec.control_hz
        self._ticks_per_step = round(rates[0] / control_hz)
        if not math.isclose(self._ticks_per_step * control_hz, rates[0]):
            raise UserError(
                f"the simulator's joints_hz={rates[0]:g} must be a multiple of the task's {control_hz:g} Hz"
            )
        if unnamed := [camera for camera in environment.spec.cameras if camera not in topics.images]:
            raise UserError(f"no topic for the task's cameras {', '.join(unnamed)}: name them in deploy.topics.images")
        super().__init__("vla_simulator")
        self.environment, self._drivable, self._limits, self.seed = environment, environment, limits, settings.seed - 1
        self._period, self._frame_period, self._command_timeout = 1 / rates[0], 1 / rates[1], settings.command_timeout
        qos = QoSProfile(depth=1)
        self._images = {
            camera: self.create_publisher(Image, topics.images[camera], qos) for camera in environment.spec.cameras
        }
        self._joints = self.create_publisher(JointState, topics.joint_states, qos)
        self._episode = self.create_publisher(String, "~/episode", LATCHED_QOS)
        self.create_subscription(JointState, topics.commands, self._on_command, qos)
        self.create_subscription(String, topics.instruction, self._on_instruction, qos)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.reset()
        self.create_timer(self._period, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def reset(self) -> None:
        """Start the next episode."""
        self.seed += 1
        self.instruction = self.environment.reset(self.seed).instruction
        if getattr(self.environment, "instructions", 1) > 1:
            raise UserError("deploy=simulator waits for one instruction per episode: set task.goal.length=1")
        self._target = self._hold_command()
        self._commanded_at: float | None = None
        self._running, self._ticks, self._until_frame = False, 0, 0.0
        self.get_logger().info(self.description)
        self._publish_episode()

    @property
    def description(self) -> str:
        """Seed and instruction of the episode."""
        return f'episode {self.seed}: "{self.instruction}"'

    def _on_reset(self, request: Any, response: Any) -> Any:
        self.reset()
        response.success, response.message = True, self.description
        return response

    def _on_instruction(self, message: String) -> None:
        valid = len(message.data) <= LONGEST_INSTRUCTION and message.data.strip()
        if valid and not self._running and not self.environment.done:
            self._running, self._ticks = True, 0

    def _on_command(self, message: JointState) -> None:
        try:
            joints, opening = messages.command_from(message.name, message.position, self._limits)
        except UserError as error:
            return self.get_logger().warning(messages.shorten(str(error), 300), throttle_duration_sec=1.0)
        self._target = (joints, self._target[1] if opening is None else opening)
        self._commanded_at = time.monotonic()

    def _tick(self) -> None:
        """Advance the simulation by one tick, then publish the measurements."""
        silence = 0.0 if self._commanded_at is None else time.monotonic() - self._commanded_at
        if silence > self._command_timeout:
            self.get_logger().warning("no commands: the arm holds its pose", throttle_duration_sec=5.0)
            # The gripper goes on closing: at its measured opening a grip would loosen.
            self._target, self._commanded_at = (self._hold_command()[0], self._target[1]), None
        self._drivable.drive(*self._target, self._period)
        self._ticks += 1
        if self._running and self._ticks % self._ticks_per_step == 0:
            self._drivable.judge()
            if self.environment.done:
                self._running = False
                preposition = "in" if self.environment.outcome == "success" else "after"
                self.get_logger().info(f"{self.environment.outcome} {preposition} {self._ticks * self._period:.1f} s")
                self._publish_episode()
        self._publish()

    def _publish(self) -> None:
        stamp = self.get_clock().now().to_msg()
        joints, velocities, opening = self._measure()
        fingers = self._limits.finger_positions(self._limits.share(opening))
        message = JointState(name=[*self._limits.joints, *self._limits.fingers])
        message.position = [*joints.tolist(), *fingers]
        message.velocity = [*velocities.tolist(), *[0.0] * len(fingers)] if len(velocities) else []
        message.header.stamp = stamp
        self._joints.publish(message)
        self._until_frame -= self._period
        if self._until_frame <= 1e-9:
            self._until_frame += self._frame_period
            for camera, image in self._drivable.look().rgb.items():
                frame = messages.fill_image(Image(), image, f"{camera}_camera_optical_frame")
                frame.header.stamp = stamp
                self._images[camera].publish(frame)

    def _hold_command(self) -> tuple[Array, float]:
        """Return the command that holds the measured pose: joints [rad] and opening 0 … 1."""
        joints, _, opening = self._measure()
        return joints.astype(float), self._limits.share(opening)

    def _measure(self) -> tuple[Array, Array, float]:
        """Return joints [rad], their velocities [rad/s] and the gripper's opening [m]."""
        spec, model = self.environment.spec, self._model
        with self.environment.blind():
            state = self._drivable.look().state
        joints, velocities = (state[spec.indices(names)] for names in (model.joints, model.velocities))
        return joints, velocities, float(state[spec.indices([model.gripper])[0]]) if model.gripper else 0.0

    def _publish_episode(self) -> None:
        world = self.environment
        steps, seconds = self._ticks // self._ticks_per_step, self._ticks * self._period
        result = (world.done, steps, seconds, world.outcome, world.task, tuple(sorted(world.milestones)))
        episode = SimulatedEpisode(self.seed, self.instruction, *result)
        self._episode.publish(String(data=json.dumps(asdict(episode))))
