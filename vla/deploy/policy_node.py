"""The policy as a managed ROS 2 node: images, joint states and instructions in, joint commands out."""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TwistStamped
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.duration import Duration as Delay
from rclpy.exceptions import ParameterException
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vla.deploy import actions, messages
from vla.deploy.actions import GoalSender, GripperGoals
from vla.deploy.control_loop import Command, ControlLoop, State
from vla.deploy.joint_limiter import Robot
from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.deploy.observer import age_of
from vla.deploy.ros import action_class
from vla.deploy.settings import COMPRESSED, FOLLOW, TRAJECTORY_ACTION, PolicySettings
from vla.io.errors import UserError
from vla.policy import Policy
from vla.robots.controllers import acts_on_joints
from vla.spec import LONGEST_INSTRUCTION, Array, Observation

LEVELS = {
    State.WAITING: DiagnosticStatus.OK,
    State.RUNNING: DiagnosticStatus.OK,
    State.HANDED_OVER: DiagnosticStatus.OK,
    State.HOLDING: DiagnosticStatus.WARN,
    State.STOPPED: DiagnosticStatus.WARN,
    State.FAULT: DiagnosticStatus.ERROR,
}
DELIVERED = Delay(seconds=1.0)  # longest wait for the last commands to arrive
# Time of a plan in every trajectory [s]. The next tick replaces it, and all of a long plan would take more than a tick.
AHEAD = 0.3
MAX_MESSAGE = 300  # length of a log line or status message [characters]
COMMANDS = {
    "joint_state": JointState,
    "trajectory": JointTrajectory,
    "forward": Float64MultiArray,
    "twist": TwistStamped,
    FOLLOW: JointState,  # tells recordings what the goals say
}


class PolicyNode(GuardedLifecycleNode):
    """Configuring warms the policy up, activating takes over the arm at its pose, deactivating brakes and holds."""

    def __init__(self, policy: Policy, settings: PolicySettings, context: Context | None = None) -> None:
        super().__init__("vla_agent", context=context)
        self.policy, self.settings = policy, settings
        self.loop: ControlLoop | None = None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # runs even if simulated time is paused
        self._timers: list[Any] = []
        self._latencies: dict[str, deque[float]] = {}
        self._stamps: dict[str, tuple[int, int]] = {}
        self._inference: tuple[Future[Array], float] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._last_tick: float | None = None
        self._reported: tuple[State | None, str] = (None, "")
        self._ignored = ""  # message about an instruction that is ignored after a stop or a fault
        self._dropped = 0
        self._arm_goals: GoalSender | None = None
        self._gripper_goals: GripperGoals | None = None
        try:
            self._declare()
        except ParameterException as error:  # in the arguments after --ros-args
            raise UserError(str(error)) from error

    # Parameters.

    def _declare(self) -> None:
        for name, value in asdict(self.settings.robot).items():
            share = name.endswith("_share")
            limits = [FloatingPointRange(from_value=0.01, to_value=1.0)] if share else []
            if name not in ("joints", "fingers"):
                value = np.asarray(value, float).tolist()  # YAML may hold whole numbers, which ROS tells from others
            self.declare_parameter(name, value, ParameterDescriptor(floating_point_range=limits))
        self.declare_parameter("command", self.settings.command)
        self.declare_parameter("image_reliability", self.settings.image_reliability)
        self.declare_parameter("dry_run", self.settings.dry_run)
        rate = FloatingPointRange(from_value=1.0, to_value=1000.0)
        self.declare_parameter(
            "command_hz", float(self.settings.command_hz), ParameterDescriptor(floating_point_range=[rate])
        )
        self.add_on_set_parameters_callback(self._require_changeable)
        self.add_post_set_parameters_callback(self._apply_shares)

    def _require_changeable(self, parameters: list[Parameter]) -> SetParametersResult:
        """Once configured, allow changes of the shares only; while active, only a smaller share of the speed."""
        for parameter in parameters:
            if self.loop is None or parameter.name == "use_sim_time":
                continue
            if not parameter.name.endswith("_share"):
                return SetParametersResult(successful=False, reason=f"clean up before changing {parameter.name}")
            raised = parameter.value > self.get_parameter(parameter.name).value
            fixed = parameter.name == "acceleration_share"  # with less the arm could not brake before its limits
            if self._timers and (raised or fixed):
                return SetParametersResult(successful=False, reason=f"deactivate before changing {parameter.name}")
        return SetParametersResult(successful=True)

    def _apply_shares(self, parameters: list[Parameter]) -> None:
        """Apply changes that were accepted, all of one request."""
        shares = {parameter.name: parameter.value for parameter in parameters if parameter.name.endswith("_share")}
        if self.loop is not None and shares:
            self.loop.limit(replace(self.loop.robot, **shares))

    # Lifecycle.

    def configure(self) -> None:
        """Check that policy, robot and topics match, warm the policy up, connect."""
        spec, topics = self.policy.spec, self.settings.topics
        unnamed = sorted(set(spec.cameras) - set(topics.images))
        if unnamed:
            missing = ", ".join(unnamed)
            raise UserError(f"no topic for the policy's cameras {missing}: add +deploy.topics.images.{unnamed[0]}")
        robot = Robot(**{name: self.get_parameter(name).value for name in asdict(self.settings.robot)})
        self._command_type = self._choice("command", COMMANDS)
        self.settings.require_messages(self._command_type)
        reliability = self._choice("image_reliability", ("best_effort", "reliable"))
        self._dry_run = dry_run = self.get_parameter("dry_run").value
        twist = self._command_type == "twist"
        if twist and acts_on_joints(spec):
            raise UserError("command=twist needs a policy of Cartesian actions, this one's are joint positions")
        rate, follows = self.get_parameter("command_hz").value, not (dry_run or twist)
        loop = ControlLoop(spec, robot, self.settings.safety, rate, follows)
        if self.settings.gripper is not None and (topics.gripper is None or not loop.has_gripper):
            missing = (
                "its action server in deploy.topics.gripper" if loop.has_gripper else "a policy that moves a gripper"
            )
            raise UserError(f"deploy/gripper needs {missing}")
        self._pool.submit(self._warm_up).result()  # in the thread of inference: compiled programs are kept per thread
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        image_qos = QoSProfile(depth=1, reliability=ReliabilityPolicy[reliability.upper()])
        for camera in spec.cameras:
            kind = CompressedImage if topics.images[camera].endswith(COMPRESSED) else Image
            self.add_subscription(kind, topics.images[camera], partial(self._on_image, camera), image_qos)
        self._joint_states = messages.JointStates(robot)
        for topic in filter(None, {topics.joint_states, topics.finger_states}):
            self.add_subscription(JointState, topic, self._on_joint_state, best_effort)
        self.add_subscription(String, topics.instruction, self._on_instruction, QoSProfile(depth=1))
        commands, gripper = self._topics_of_commands()
        self._commands = self.add_publisher(COMMANDS[self._command_type], commands, while_active=True)
        self._gripper = self.add_publisher(Float64MultiArray, gripper, while_active=True) if gripper else None
        self._status = self.add_publisher(DiagnosticStatus, "~/status")
        self._diagnostics = self.add_publisher(DiagnosticArray, "/diagnostics")
        self._arm = self.add_publisher(String, "~/arm")
        self._description = messages.fill_arm(String(), robot, spec.require_robot("deployment"))
        self.add_service(Trigger, "~/stop", self._on_stop)
        self.add_service(Trigger, "~/resume", self._on_resume)
        self.add_service(SetBool, "~/hand_over", self._on_hand_over)
        self._connect_actions()
        self._latencies, self._stamps, self._dropped = {}, {}, 0
        self.loop = loop

    def _topics_of_commands(self) -> tuple[str, str | None]:
        """Return the topics of the commands and of the finger positions: of an action, copies for recordings."""
        topics, below = self.settings.topics, "~/dry_run" if self._dry_run else "~"
        own = self._dry_run or self._command_type == FOLLOW
        own_gripper = self._dry_run or self.settings.gripper is not None
        commands = f"{below}/commands" if own else topics.commands
        return commands, topics.gripper and (f"{below}/gripper" if own_gripper else topics.gripper)

    def _choice(self, name: str, choices: Collection[str]) -> str:
        """Return a parameter that must be one of `choices`."""
        value = str(self.get_parameter(name).value)
        if value not in choices:
            raise UserError(f"{name} is '{value}', expected one of {', '.join(choices)}")
        return value

    def _connect_actions(self) -> None:
        """Create the clients of the actions; a dry run has none."""
        topics, gripper = self.settings.topics, self.settings.gripper
        if self._command_type == FOLLOW and not self._dry_run:
            kind, complaint = action_class(*TRAJECTORY_ACTION), actions.trajectory_complaint
            self._arm_goals = GoalSender(self, kind, topics.commands, complaint, self._fail)
        if gripper is not None and topics.gripper is not None and not self._dry_run:
            self._gripper_goals = GripperGoals(self, gripper, topics.gripper, self._fail)

    @property
    def _senders(self) -> list[GoalSender]:
        gripper = self._gripper_goals.senders.values() if self._gripper_goals is not None else ()
        return [*([self._arm_goals] if self._arm_goals is not None else []), *gripper]

    def _fail(self, reason: str) -> None:
        """Stop because of an action; the first reason counts."""
        if self.loop is not None and self.loop.state is not State.FAULT:
            self.loop.fail(reason)

    def _warm_up(self) -> None:
        """Run three inferences on noise: the first ones are slow."""
        noise = self.policy.spec.random_observation(np.random.default_rng(0))
        for _ in range(3):
            self.policy.reset("", 0)
            self.policy.plan(noise)
        self.policy.reset("", 0)

    def activate(self) -> None:
        """Take over the arm at its measured pose."""
        assert self.loop is not None
        self._require_only_commander()
        self._require_servers()
        self.loop.restart()
        self._inference, self._last_tick = None, None
        self._timers = [
            self.create_timer(self.loop.tick, self.guard(self._tick), clock=self._steady),
            self.create_timer(1.0, self.guard(self._report), clock=self._steady),
        ]

    def _require_only_commander(self) -> None:
        others = self.count_publishers(self._commands.topic_name) - 1
        if others > 0:
            raise UserError(f"{others} other publisher(s) on {self._commands.topic_name}: stop them first")

    def _require_servers(self) -> None:
        for sender in self._senders:
            sender.require_server()
            sender.reset()
        if self._gripper_goals is not None:
            self._gripper_goals.reset()

    def brake(self) -> None:
        """Publish commands until the arm is at rest, then stop the timers."""
        if not self._timers or self.loop is None:
            return
        self.loop.stop("deactivated", "activate the agent")
        self._come_to_rest(self.loop)
        for timer in self._timers:
            self.destroy_timer(timer)
        self._timers = []
        self._report()

    def _come_to_rest(self, loop: ControlLoop) -> None:
        """Publish commands of a loop that brakes until the arm is at rest."""
        while True:
            self._send()
            if loop.limiter.resting:
                break
            time.sleep(loop.tick)
        self._commands.wait_for_all_acked(DELIVERED)  # the last ones must arrive, even if the node then ends
        time.sleep(2 * loop.tick if self._senders else 0.0)  # a server is a little behind
        for sender in self._senders:
            sender.cancel()

    def clean_up(self) -> None:
        """Shut the inference thread down and drop the control loop."""
        self._pool.shutdown(cancel_futures=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")  # starts its thread with the first inference
        for sender in self._senders:
            sender.destroy()
        self._arm_goals, self._gripper_goals = None, None
        self.loop = None

    def on_callback_error(self, reason: str) -> None:
        """Brake and hold until deactivated."""
        if self.loop is not None:
            self.loop.fail(reason)

    # Inputs.

    def _on_image(self, camera: str, message: Any) -> None:
        now = time.monotonic()
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        age = age_of(stamp, self.get_clock().now().nanoseconds * 1e-9)  # now: decoding takes its time
        if not self._timers or self.loop is None:
            return
        if stamp != (0, 0) and stamp == self._stamps.get(camera):
            return self._drop(f"two images of the camera {camera} have the same time stamp: is its clock frozen?")
        self._stamps[camera] = stamp
        try:
            image = messages.image_from(message)
        except ValueError as error:
            return self._drop(f"camera {camera}: {error}")
        self._record("image age", age)
        self.loop.on_image(camera, image, now - age)
        return self._advance()

    def _on_joint_state(self, message: JointState) -> None:
        now = time.monotonic()
        if not self._timers or self.loop is None:
            return
        try:
            measured = self._joint_states.read(message, now)
        except ValueError as error:
            return self._drop(str(error))
        if measured is not None:
            self.loop.on_joint_state(*measured, now)

    def _on_instruction(self, message: String) -> None:
        if not self._timers or self.loop is None:
            return
        instruction, loop = message.data, self.loop
        quoted = repr(messages.shorten(instruction))
        if (length := len(instruction)) > LONGEST_INSTRUCTION:
            return self._drop(f"an instruction of {length} characters, the limit is {LONGEST_INSTRUCTION}: {quoted}")
        repeated = instruction.strip() == loop.instruction
        if loop.on_instruction(instruction, time.monotonic()):
            if not repeated:
                self.get_logger().info(f"instruction: {quoted}")
        elif instruction.strip():
            self._report_ignored(f"instruction ignored while {loop.state}: {quoted}; {loop.reason}")

    def _report_ignored(self, message: str) -> None:
        if message != self._ignored:
            self._ignored = message
            self.get_logger().warning(messages.shorten(message, MAX_MESSAGE))
            self._report()

    def _on_stop(self, request: Any, response: Any) -> Any:
        response.success = bool(self._timers)
        if self.loop is not None:
            self.loop.stop("stopped by request")
            self._report()  # before an instruction is ignored, whose warning this would clear
        return response

    def _on_resume(self, request: Any, response: Any) -> Any:
        response.success = bool(self._timers) and self.loop is not None and self.loop.resume(time.monotonic())
        response.message = "" if response.success else "nothing to resume: the agent is not stopped"
        return response

    def _on_hand_over(self, request: Any, response: Any) -> Any:
        """Leave the resting arm to a person, or take it back at its measured pose."""
        loop = self.loop
        if loop is None or not self._timers:
            response.message = "the agent is not active"
            return response
        try:
            if request.data and not loop.handed_over:
                loop.hold("a person takes over")
                self._come_to_rest(loop)
                loop.hand_over()
            elif not request.data and loop.handed_over:
                self._require_only_commander()
                self._require_servers()
                loop.take_back(time.monotonic())
            response.success = True
        except ValueError as error:
            response.message = str(error)
        self._report()
        return response

    def _drop(self, reason: str) -> None:
        self._dropped += 1
        self.get_logger().warning(messages.shorten(reason, MAX_MESSAGE), throttle_duration_sec=1.0)

    # Commands.

    def _tick(self) -> None:
        now = time.monotonic()
        if self._last_tick is not None:
            self._record("tick", now - self._last_tick)
        self._last_tick = now
        if not self.loop or not self.loop.handed_over:
            for sender in self._senders:
                sender.check()
        self._advance()
        self._send()

    def _advance(self) -> None:
        """Schedule a finished inference, and start the next one if it is due."""
        assert self.loop is not None
        if self._inference is not None and self._inference[0].done():
            (future, started), self._inference = self._inference, None
            try:
                self.loop.set_plan(future.result())
                self._record("inference", time.monotonic() - started)
                self._record("image to command", time.monotonic() - self.loop.observed_at)
            except Exception as error:
                self.get_logger().error(f"the policy failed: {traceback.format_exc()}", throttle_duration_sec=1.0)
                self.loop.reject_plan(f"the policy failed: {error}")
        if self._inference is None:
            observation = self.loop.next_observation(time.monotonic())
            if observation is not None:
                self._inference = (self._pool.submit(self._infer, observation, self.loop.resumed), time.monotonic())

    def _infer(self, observation: Observation, reset: bool) -> Array:
        if reset:
            self.policy.reset(observation.instruction, 0)
        plan = self.policy.plan(observation)
        # In training the frames of a history have no gaps either.
        return plan[: 1 if getattr(self.policy, "history", 1) > 1 else self.policy.execute]

    def _send(self) -> None:
        assert self.loop is not None
        now = time.monotonic()
        command = self.loop.command(now)
        if command is not None:
            self._publish(command, now)
        if (self.loop.state, self.loop.reason) != self._reported:
            self._report()

    def _publish(self, command: Command, now: float) -> None:
        assert self.loop is not None
        robot = self.loop.robot
        if self._gripper_goals is not None and not self.loop.acting:
            self._gripper_goals.hold()
        elif self._gripper_goals is not None and command.opening is not None:
            self._gripper_goals.command(command.opening)
        if self._arm_goals is not None and (ahead := self.loop.commit(command, now)) is not None:
            goal = self._arm_goals.kind.Goal()
            self._fill_trajectory(goal.trajectory, ahead)
            self._arm_goals.send(goal)
        if self._command_type in ("joint_state", FOLLOW):
            message = messages.fill_joint_state(JointState(), robot, command)
            message.header.stamp = self.get_clock().now().to_msg()
        elif self._command_type == "trajectory":
            ahead = [command, *self.loop.horizon(now, AHEAD)]  # the next trajectory replaces all points after the first
            message = self._fill_trajectory(JointTrajectory(), ahead)
        elif self._command_type == "twist":
            frame = self.settings.twist_frame or self.policy.spec.require_robot("deployment").frame
            message = messages.fill_twist(TwistStamped(), frame, self.loop.tool_velocity(command))
            message.header.stamp = self.get_clock().now().to_msg()
        else:
            message = Float64MultiArray(data=command.position.tolist())
        self._commands.publish(message)
        fingers = messages.finger_positions(robot, command)
        if self._gripper is not None and fingers:
            self._gripper.publish(Float64MultiArray(data=fingers))

    def _fill_trajectory(self, message: Any, ahead: list[Command]) -> Any:
        assert self.loop is not None
        return messages.fill_trajectory(message, JointTrajectoryPoint, Duration, self.loop.robot, ahead, self.loop.tick)

    def _record(self, name: str, seconds: float) -> None:
        self._latencies.setdefault(name, deque(maxlen=500)).append(seconds)

    def _report(self) -> None:
        """Publish status and description of the arm, log changes of state, and check for conflicting publishers."""
        loop = self.loop
        assert loop is not None
        if self._timers:
            self._check_publishers()
        if (loop.state, loop.reason) != self._reported:
            self._reported, self._ignored = (loop.state, loop.reason), ""
            line = f"{loop.state}: {messages.shorten(loop.reason, MAX_MESSAGE)}".removesuffix(": ")
            # Two calls, because rclpy refuses to log with changing severity from one line.
            if LEVELS[loop.state] == DiagnosticStatus.OK:
                self.get_logger().info(line)
            else:
                self.get_logger().warning(line)
        values = {
            "state": loop.state.value,
            messages.HANDED_OVER: "yes" if loop.handed_over or self._dry_run else "no",
            "instruction": messages.shorten(loop.instruction),
            "messages dropped": str(self._dropped),
            "late plans": str(loop.late_plans),
        }
        for name, seconds in self._latencies.items():
            middle, high = np.percentile(list(seconds), [50, 99]) * 1000
            values[f"{name} p50 [ms]"], values[f"{name} p99 [ms]"] = f"{middle:.1f}", f"{high:.1f}"
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        text = messages.shorten(self._ignored or loop.reason or loop.state.value, MAX_MESSAGE)
        status = DiagnosticStatus(level=LEVELS[loop.state], name=self.get_name(), message=text, values=pairs)
        self._status.publish(status)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)
        self._arm.publish(self._description)

    def _check_publishers(self) -> None:
        """Fault if another node commands the arm, hold if a camera topic has several publishers."""
        assert self.loop is not None
        if self.count_publishers(self._commands.topic_name) > 1 and not self.loop.handed_over:
            self.loop.fail(f"another node commands the arm on {self._commands.topic_name}")
        for camera in self.policy.spec.cameras:
            topic = self.resolve_topic_name(self.settings.topics.images[camera])
            if (count := self.count_publishers(topic)) > 1:
                self.loop.hold(f"{count} publishers send images on {topic}")
