"""The policy as a managed ROS 2 node: images, joint states and instructions in, joint commands out."""

from __future__ import annotations

import time
import traceback
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleState
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from vla.deploy.commands import outputs
from vla.deploy.control_loop import ControlLoop
from vla.deploy.diagnostics import Diagnostics
from vla.deploy.inference import Inference
from vla.deploy.inputs import Inputs
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.lifecycle_node import GuardedLifecycleNode, transition
from vla.deploy.safety import State
from vla.deploy.settings import PolicySettings
from vla.io.errors import UserError
from vla.policy import Policy
from vla.robots.controllers import acts_on_joints

SHARES = ("speed_share", "acceleration_share")  # the parameters
DELIVERED = Duration(seconds=1.0)  # longest wait for the last commands to arrive


class PolicyNode(GuardedLifecycleNode):
    """Configuring warms the policy up, activating takes over the arm at its pose, deactivating brakes and holds."""

    def __init__(self, policy: Policy, settings: PolicySettings, context: Context | None = None) -> None:
        super().__init__("vla_agent", context=context)
        self.policy, self.settings = policy, settings
        self.loop: ControlLoop | None = None  # while configured
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # runs even if simulated time is paused
        self._timers: list[Any] = []  # while active
        span = FloatingPointRange(from_value=0.01, to_value=1.0)
        try:
            for share in SHARES:
                value = float(getattr(settings.robot, share))  # YAML may hold whole numbers
                self.declare_parameter(share, value, ParameterDescriptor(floating_point_range=[span]))
        except ParameterException as error:  # in the arguments after --ros-args
            raise UserError(str(error)) from error
        self.add_on_set_parameters_callback(self._require_changeable)
        self.add_post_set_parameters_callback(self._apply_shares)

    def _require_changeable(self, parameters: list[Parameter]) -> SetParametersResult:
        """While active, allow only a smaller share of the speed."""
        for parameter in (each for each in parameters if self.active and each.name in SHARES):
            raised = parameter.value > self.get_parameter(parameter.name).value
            # With less acceleration the arm could not brake before its limits.
            if raised or parameter.name == "acceleration_share":
                return SetParametersResult(successful=False, reason=f"deactivate before changing {parameter.name}")
        return SetParametersResult(successful=True)

    def _apply_shares(self, parameters: list[Parameter]) -> None:
        """Apply changes that were accepted."""
        if self.loop is not None:
            self.loop.limit(self._limits)

    @property
    def _limits(self) -> JointLimits:
        """The limits with the parameters as they are now."""
        return replace(self.settings.robot, **{share: self.get_parameter(share).value for share in SHARES})

    @property
    def active(self) -> bool:
        """Whether the node commands the arm, or has handed it over."""
        return bool(self._timers)

    @transition
    def on_configure(self, state: LifecycleState) -> None:
        """Check that policy, robot and topics match, warm the policy up, connect."""
        settings, topics = self.settings, self.settings.topics
        if unnamed := sorted(set(self.policy.spec.cameras) - set(topics.images)):
            missing = ", ".join(unnamed)
            raise UserError(f"no topic for the policy's cameras {missing}: add +deploy.topics.images.{unnamed[0]}")
        twist = settings.command == "twist"
        if twist and acts_on_joints(self.policy.spec):
            raise UserError("command=twist needs a policy of Cartesian actions, this one's are joint positions")
        follows_positions = not (settings.dry_run or twist)
        policy, limits = self.policy, self._limits
        execute = policy.execute if getattr(policy, "chunking", None) else None
        loop = ControlLoop(policy.spec, limits, settings.safety, settings.command_hz, follows_positions, execute)
        if settings.gripper is not None and not loop.goals.has_gripper:
            raise UserError("deploy/gripper needs a policy that moves a gripper")
        if settings.gripper is not None and topics.gripper is None:
            raise UserError("deploy/gripper needs its action server in deploy.topics.gripper")
        self._inference = Inference(self.policy)
        self._inference.warm_up()
        self.diagnostics = Diagnostics(self, loop, settings.dry_run)
        Inputs(self, loop, settings, self.diagnostics, self._advance)
        self._outputs = outputs(self, loop, settings)
        self._commands = self._outputs[0].publisher
        self.add_service(Trigger, "~/stop", self._on_stop)
        self.add_service(Trigger, "~/resume", self._on_resume)
        self.add_service(SetBool, "~/hand_over", self._on_hand_over)
        self.loop = loop

    @transition
    def on_activate(self, state: LifecycleState) -> None:
        """Take over the arm at its measured pose."""
        assert self.loop is not None
        self._require_command()
        self.loop.restart()
        self._inference.forget()
        self._last_tick: float | None = None
        self._timers = [
            self.create_timer(self.loop.tick, self.guard(self._tick), clock=self._steady),
            self.create_timer(1.0, self.guard(self._check_publishers), clock=self._steady),
        ]
        super().on_activate(state)

    def _require_command(self) -> None:
        """Raise a UserError if another node commands the arm, or an action server is not there."""
        others = self.count_publishers(self._commands.topic_name) - 1
        if others > 0:
            raise UserError(f"{others} other publisher(s) on {self._commands.topic_name}: stop them first")
        for output in self._outputs:
            output.prepare()

    @transition
    def on_deactivate(self, state: LifecycleState) -> None:
        """Brake while the publishers are still active."""
        self.brake()
        super().on_deactivate(state)

    @transition
    def on_shutdown(self, state: LifecycleState) -> None:
        """Brake and clean up."""
        self.brake()
        self.on_cleanup(state)

    @transition
    def on_cleanup(self, state: LifecycleState) -> None:
        """Shut the inference thread down, drop the control loop, and disconnect."""
        if self.loop is not None:
            self._inference.close()
        self.loop = None
        self.destroy_created()

    def brake(self) -> None:
        """Publish commands until the arm is at rest, then stop the timers; does nothing if the node is inactive."""
        if self.loop is None or not self.active:
            return
        self.loop.stop("deactivated", "activate the agent")
        self._come_to_rest(self.loop)
        for timer in self._timers:
            self.destroy_timer(timer)
        self._timers = []
        self.diagnostics.report()

    def _come_to_rest(self, loop: ControlLoop) -> None:
        """Publish commands of a loop that brakes until the arm is at rest."""
        while True:
            self._send(loop)
            if loop.motion.limiter.resting:
                break
            time.sleep(loop.tick)
        self._commands.wait_for_all_acked(DELIVERED)  # the last ones must arrive, even if the node then ends
        senders = [sender for output in self._outputs for sender in output.senders]
        time.sleep(2 * loop.tick if senders else 0.0)  # a server is a little behind
        for sender in senders:
            sender.cancel()

    def fail(self, reason: str) -> None:
        """Brake and hold until deactivated; the first reason counts."""
        if self.loop is not None and self.loop.state is not State.FAULT:
            self.loop.fail(reason)

    def _on_stop(self, request: Any, response: Any) -> Any:
        response.success = self.active
        if self.loop is not None:
            self.loop.stop("stopped by request")
            self.diagnostics.report()  # before an instruction is ignored, whose warning this would clear
        return response

    def _on_resume(self, request: Any, response: Any) -> Any:
        response.success = self.loop is not None and self.active and self.loop.resume(time.monotonic())
        response.message = "" if response.success else "nothing to resume: the agent is not stopped"
        return response

    def _on_hand_over(self, request: Any, response: Any) -> Any:
        """Leave the resting arm to a person, or take it back at its measured pose."""
        loop = self.loop
        try:
            if loop is None or not self.active:
                raise UserError("the agent is not active")
            if request.data and not loop.handed_over:
                loop.hold("a person takes over")
                self._come_to_rest(loop)
                loop.hand_over()
            elif not request.data and loop.handed_over:
                self._require_command()
                loop.take_back(time.monotonic())
            response.success = True
            self.diagnostics.report()
        except UserError as error:
            response.message = str(error)
        return response

    def _tick(self) -> None:
        now = time.monotonic()
        if self._last_tick is not None:
            self.diagnostics.record("tick", now - self._last_tick)
        self._last_tick = now
        assert self.loop is not None
        for output in () if self.loop.handed_over else self._outputs:
            for sender in output.senders:
                sender.check()
        self._advance()
        self._send(self.loop)

    def _advance(self) -> None:
        """Schedule a finished inference, and start the next one if it is due."""
        loop, inference = self.loop, self._inference
        assert loop is not None
        try:
            if (done := inference.take()) is not None:
                plan, seconds = done
                loop.set_plan(plan)
                delay = time.monotonic() - loop.observed_at
                loop.delays.add(delay)
                self.diagnostics.record("inference", seconds)
                self.diagnostics.record("image to command", delay)
        except Exception as error:
            self.get_logger().error(f"the policy failed: {traceback.format_exc()}", throttle_duration_sec=1.0)
            loop.reject_plan(f"the policy failed: {error}")
        if not inference.busy and (observation := loop.next_observation(time.monotonic())) is not None:
            inference.start(observation, loop.resumed)

    def _send(self, loop: ControlLoop) -> None:
        """Pass this tick's command on."""
        now = time.monotonic()
        if (command := loop.command(now)) is not None:
            for output in self._outputs:
                output.publish(command, now)
        self.diagnostics.report_changes()

    def _check_publishers(self) -> None:
        """Fault if another node commands the arm, hold if a camera topic has several publishers; report."""
        assert self.loop is not None
        commands = self._commands.topic_name
        if self.count_publishers(commands) > 1 and not self.loop.handed_over:
            self.loop.fail(f"another node commands the arm on {commands}")
        for camera in self.policy.spec.cameras:
            topic = self.resolve_topic_name(self.settings.topics.images[camera])
            if (count := self.count_publishers(topic)) > 1:
                self.loop.hold(f"{count} publishers send images on {topic}")
        self.diagnostics.report()
