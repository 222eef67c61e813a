"""The policy as a managed ROS 2 node: images, joint states and words in, joint commands out."""

from __future__ import annotations

import time
import traceback
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from typing import Any, get_args

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vla.deploy import images, messages
from vla.deploy.governor import Robot
from vla.deploy.managed import Managed
from vla.deploy.ros2 import Ros2
from vla.deploy.session import Session, State
from vla.policy import Policy
from vla.spec import LONGEST_INSTRUCTION, Array, Observation

LEVELS = {
    State.WAITING: DiagnosticStatus.OK,
    State.RUNNING: DiagnosticStatus.OK,
    State.HOLDING: DiagnosticStatus.WARN,
    State.STOPPED: DiagnosticStatus.WARN,
    State.FAULT: DiagnosticStatus.ERROR,
}
LONGEST_LINE = 300  # of what the agent says of itself [characters]
COMMANDS = {"joint_state": JointState, "trajectory": JointTrajectory, "forward": Float64MultiArray}


class Agent(Managed):
    """Configure makes room and warms up, activate takes the arm over where it stands, deactivate brakes and holds."""

    def __init__(self, policy: Policy, settings: Ros2, context: Context | None = None) -> None:
        super().__init__("vla_agent", context=context)
        self.policy, self.settings = policy, settings
        self.session: Session | None = None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on where simulated time stands still
        self._timers: list[Any] = []
        self._figures: dict[str, deque[float]] = {}
        self._stamps: dict[str, tuple[int, int]] = {}
        self._sizes: dict[str, tuple[int, ...]] = {}  # camera → shape of its last image
        self._asked: tuple[Future[Array], float] | None = None
        self._last_tick: float | None = None
        self._told: tuple[State | None, str] = (None, "")
        self._unheeded = ""  # an instruction that a stop or a fault keeps from being followed, in words
        self._dropped = 0
        try:
            self._declare()
        except ParameterException as error:  # of what stands behind --ros-args
            raise ValueError(str(error)) from error

    # Parameters.

    def _declare(self) -> None:
        for name, value in asdict(self.settings.robot).items():
            share = name.endswith("_share")
            limits = [FloatingPointRange(from_value=0.01, to_value=1.0)] if share else []
            value = list(value) if isinstance(value, (list, tuple)) else value
            self.declare_parameter(name, value, ParameterDescriptor(floating_point_range=limits))
        self.declare_parameter("command", self.settings.command)
        self.declare_parameter("image_reliability", self.settings.image_reliability)
        self.declare_parameter("image_crop", self.settings.image_crop)
        rate = FloatingPointRange(from_value=1.0, to_value=1000.0)
        self.declare_parameter("command_hz", self.settings.command_hz, ParameterDescriptor(floating_point_range=[rate]))
        self.add_on_set_parameters_callback(self._may_set)

    def _may_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """While configured only the shares change, and while active they only sink."""
        for parameter in parameters:
            if self.session is None or not self.has_parameter(parameter.name) or parameter.name == "use_sim_time":
                continue
            if not parameter.name.endswith("_share"):
                return SetParametersResult(successful=False, reason=f"clean up before {parameter.name} changes")
            if self._timers and parameter.value > self.get_parameter(parameter.name).value:
                return SetParametersResult(successful=False, reason=f"deactivate before {parameter.name} is raised")
            governor = self.session.governor
            governor.robot = replace(governor.robot, **{parameter.name: parameter.value})
        return SetParametersResult(successful=True)

    # Lifecycle.

    def configure(self) -> None:
        """Check that policy, robot and topics fit, warm the policy up, connect."""
        spec, topics = self.policy.spec, self.settings.topics
        unnamed = sorted(set(spec.cameras) - set(topics.images))
        if unnamed:
            raise ValueError(f"the policy looks through {', '.join(unnamed)}: name deploy.topics.images.{unnamed[0]}")
        robot = Robot(**{name: self.get_parameter(name).value for name in asdict(self.settings.robot)})
        self._kind = self.get_parameter("command").value
        if self._kind not in COMMANDS:
            raise ValueError(f"command is '{self._kind}', there are {', '.join(COMMANDS)}")
        self._crop = self.get_parameter("image_crop").value
        if self._crop not in get_args(images.Crop):
            raise ValueError(f"image_crop is '{self._crop}', there are {', '.join(get_args(images.Crop))}")
        session = Session(spec, robot, self.settings.safety, self.get_parameter("command_hz").value)
        self._warm_up()
        reliable = self.get_parameter("image_reliability").value == "reliable"
        newest = QoSProfile(
            depth=1, reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        )
        latest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        for camera in spec.cameras:
            self.subscribe(Image, topics.images[camera], partial(self._on_image, camera), newest)
        self.subscribe(JointState, topics.joint_states, self._on_joints, latest)
        self.subscribe(String, topics.instruction, self._on_instruction, QoSProfile(depth=1))
        self._commands = self.publish(COMMANDS[self._kind], topics.commands, while_active=True)
        self._gripper = self.publish(Float64MultiArray, topics.gripper, while_active=True) if topics.gripper else None
        self._status = self.publish(DiagnosticStatus, "~/status")
        self._diagnostics = self.publish(DiagnosticArray, "/diagnostics")
        self.serve(Trigger, "~/stop", self._on_stop)
        self.serve(Trigger, "~/resume", self._on_resume)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._figures, self._stamps, self._sizes, self._dropped = {}, {}, {}, 0
        self.session = session

    def _warm_up(self) -> None:
        """Ask the policy about nothing, three times: the first answers are slow."""
        spec = self.policy.spec
        nothing = Observation(
            rgb={camera: np.zeros((*spec.image_size, 3), np.uint8) for camera in spec.cameras},
            depth={},
            joints=np.zeros(len(spec.joints), np.float32),
            velocities=np.zeros(len(spec.joints), np.float32),
            gripper=0.0,
            instruction="",
        )
        for _ in range(3):
            self.policy.reset("", 0)
            self.policy.plan(nothing)
        self.policy.reset("", 0)

    def activate(self) -> None:
        """Take the arm over where it stands."""
        assert self.session is not None
        others = self.count_publishers(self._commands.topic_name) - 1
        if others > 0:
            raise ValueError(
                f"{others} other publisher(s) command the arm on {self._commands.topic_name}: end them first"
            )
        self.session.restart()
        self._asked, self._last_tick = None, None
        self._timers = [
            self.create_timer(self.session.tick, self.guard(self._tick), clock=self._steady),
            self.create_timer(1.0, self.guard(self._report), clock=self._steady),
        ]

    def come_to_rest(self) -> None:
        """Brake, publish the pose that is held, and end the timers."""
        if not self._timers or self.session is None:
            return
        self.session.stop("deactivated", "activate the agent")
        while True:
            self._send()
            if self.session.governor.resting:
                break
            time.sleep(self.session.tick)
        for timer in self._timers:
            self.destroy_timer(timer)
        self._timers = []
        self._report()

    def clean_up(self) -> None:
        """Let everything go."""
        self._pool.shutdown(cancel_futures=True)
        self.session = None

    def broken(self, reason: str) -> None:
        """Stand still until deactivated."""
        if self.session is not None:
            self.session.fail(reason)

    # What comes in.

    def _on_image(self, camera: str, message: Image) -> None:
        now = time.monotonic()
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        if not self._timers or self.session is None:
            return
        if stamp != (0, 0) and stamp == self._stamps.get(camera):
            return self._drop(f"an image of the camera {camera} came twice; does its clock stand still?")
        self._stamps[camera] = stamp
        try:
            image = messages.image_from(message)
        except ValueError as error:
            return self._drop(f"camera {camera}: {error}")
        if self._sizes.get(camera) != image.shape:
            self._sizes[camera] = image.shape
            if change := images.change(image, self.policy.spec.image_size, self._crop):
                self.get_logger().info(f"camera {camera}: {change}")
        age = self._age(stamp)
        self._note("image age", age)
        self.session.see(camera, image, now - age)
        return self._advance()

    def _on_joints(self, message: JointState) -> None:
        now = time.monotonic()
        if not self._timers or self.session is None:
            return
        try:
            joints, velocities, opening = messages.joints_from(message, self.session.robot)
        except ValueError as error:
            return self._drop(str(error))
        self.session.feel(joints, velocities, opening, now)

    def _on_instruction(self, message: String) -> None:
        if not self._timers or self.session is None:
            return
        words, session = message.data, self.session
        quoted = repr(messages.cut(words))
        if len(words) > LONGEST_INSTRUCTION:
            return self._drop(f"an instruction of {len(words)} characters, at most {LONGEST_INSTRUCTION} fit: {quoted}")
        known = words.strip() == session.instruction
        if session.listen(words, time.monotonic()):
            if not known:
                self.get_logger().info(f"instruction: {quoted}")
        elif words.strip():
            self._unheed(f"heard, but {session.state}: {quoted}; {session.reason}")

    def _unheed(self, words: str) -> None:
        if words != self._unheeded:
            self._unheeded = words
            self.get_logger().warning(messages.cut(words, LONGEST_LINE))
            self._report()

    def _on_stop(self, request: Any, response: Any) -> Any:
        response.success = bool(self._timers)
        if self.session is not None:
            self.session.stop("stopped by request")
        return response

    def _on_resume(self, request: Any, response: Any) -> Any:
        response.success = bool(self._timers) and self.session is not None and self.session.resume(time.monotonic())
        response.message = "" if response.success else "there is nothing to resume: the agent was not stopped"
        return response

    def _drop(self, why: str) -> None:
        self._dropped += 1
        self.get_logger().warning(messages.cut(why, LONGEST_LINE), throttle_duration_sec=1.0)

    def _age(self, stamp: tuple[int, int]) -> float:
        """Age [s] of a message by its stamp; 0 where the stamp cannot be of this clock."""
        age = self.get_clock().now().nanoseconds * 1e-9 - (stamp[0] + stamp[1] * 1e-9)
        return age if stamp != (0, 0) and 0 <= age < 10.0 else 0.0

    # What goes out.

    def _tick(self) -> None:
        now = time.monotonic()
        if self._last_tick is not None:
            self._note("tick", now - self._last_tick)
        self._last_tick = now
        self._advance()
        self._send()

    def _advance(self) -> None:
        """Take the policy's answer if there is one, and ask it again if it is time to."""
        assert self.session is not None
        if self._asked is not None and self._asked[0].done():
            (future, started), self._asked = self._asked, None
            try:
                self.session.plan(future.result(), time.monotonic())
                self._note("inference", time.monotonic() - started)
                self._note("image to command", time.monotonic() - self.session.observed)
            except Exception as error:
                self.get_logger().error(f"the policy failed: {traceback.format_exc()}", throttle_duration_sec=1.0)
                self.session.reject(f"the policy failed: {error}")
        if self._asked is None:
            observation = self.session.look(time.monotonic())
            if observation is not None:
                self._asked = (self._pool.submit(self._think, observation, self.session.resumed), time.monotonic())

    def _think(self, observation: Observation, afresh: bool) -> Array:
        if afresh:
            self.policy.reset(observation.instruction, 0)
        size = self.policy.spec.image_size
        rgb = {camera: images.fitted(image, size, self._crop) for camera, image in observation.rgb.items()}
        return self.policy.plan(replace(observation, rgb=rgb))[: self.policy.execute]

    def _send(self) -> None:
        assert self.session is not None
        now = time.monotonic()
        command = self.session.command(now)
        if command is None:
            return
        robot = self.session.robot
        if self._kind == "joint_state":
            message = messages.fill_joint_state(JointState(), robot, command)
            message.header.stamp = self.get_clock().now().to_msg()
        elif self._kind == "trajectory":
            ahead = [command, *self.session.horizon(now)]  # the next trajectory replaces all after the first
            message = messages.fill_trajectory(
                JointTrajectory(), JointTrajectoryPoint, Duration, robot, ahead, self.session.tick
            )
        else:
            message = Float64MultiArray(data=command.position.tolist())
        self._commands.publish(message)
        if self._gripper is not None:
            self._gripper.publish(Float64MultiArray(data=messages.finger_positions(robot, command)))
        if (self.session.state, self.session.reason) != self._told:
            self._report()

    def _note(self, name: str, seconds: float) -> None:
        self._figures.setdefault(name, deque(maxlen=500)).append(seconds)

    def _report(self) -> None:
        """Status once a second and on every change; what others do to our topics is looked at here too."""
        session = self.session
        assert session is not None
        if self._timers:
            self._look_for_others()
        if (session.state, session.reason) != self._told:
            self._told, self._unheeded = (session.state, session.reason), ""
            words = f"{session.state}: {messages.cut(session.reason, LONGEST_LINE)}".removesuffix(": ")
            # One line each: rclpy does not let one and the same line log with changing severity.
            if LEVELS[session.state] == DiagnosticStatus.OK:
                self.get_logger().info(words)
            else:
                self.get_logger().warning(words)
        values = {
            "state": session.state.value,
            "instruction": messages.cut(session.instruction),
            "messages dropped": str(self._dropped),
            "ticks skipped": str(session.overruns),
        }
        for name, figures in self._figures.items():
            middle, high = np.percentile(list(figures), [50, 99]) * 1000
            values[f"{name} p50 [ms]"], values[f"{name} p99 [ms]"] = f"{middle:.1f}", f"{high:.1f}"
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        text = messages.cut(self._unheeded or session.reason or session.state.value, LONGEST_LINE)
        status = DiagnosticStatus(level=LEVELS[session.state], name=self.get_name(), message=text, values=pairs)
        self._status.publish(status)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _look_for_others(self) -> None:
        """Two who command one arm, or two cameras on one topic, are a fault that nobody else would notice."""
        assert self.session is not None
        if self.count_publishers(self._commands.topic_name) > 1:
            self.session.fail(f"somebody else commands the arm on {self._commands.topic_name}")
        for camera in self.policy.spec.cameras:
            topic = self.resolve_topic_name(self.settings.topics.images[camera])
            if self.count_publishers(topic) > 1:
                self.session.hold(f"{self.count_publishers(topic)} publishers send images on {topic}")
