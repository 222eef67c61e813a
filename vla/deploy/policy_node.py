"""The policy as a managed ROS 2 node: images, joint states and instructions in, joint commands out."""

from __future__ import annotations

import time
import traceback
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState
from std_srvs.srv import SetBool, Trigger

from vla.deploy.commands import ArmOutput, GripperOutput
from vla.deploy.control_loop import ControlLoop
from vla.deploy.diagnostics import Diagnostics
from vla.deploy.inference import Inference
from vla.deploy.inputs import Inputs
from vla.deploy.lifecycle_node import GuardedLifecycleNode, transition
from vla.deploy.safety import State, clock
from vla.deploy.settings import PolicySettings
from vla.io.errors import UserError
from vla.policy import Policy
from vla.rollouts.realtime import actions_per_plan

DELIVERY_TIMEOUT = Duration(seconds=1.0)  # longest wait for the last commands to arrive


class PolicyNode(GuardedLifecycleNode):
    """Configuring warms the policy up, activating takes over the arm at its pose, deactivating brakes and holds."""

    def __init__(self, policy: Policy, settings: PolicySettings, context: Context | None = None) -> None:
        super().__init__("vla_agent", context=context)
        self.policy, self.settings = policy, settings
        self.loop: ControlLoop | None = None  # while configured
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)  # runs even if simulated time is paused
        self._timers: list[Any] = []  # while active

    @property
    def active(self) -> bool:
        """Whether the node commands the arm, or has handed it over."""
        return bool(self._timers)

    @transition
    def on_configure(self, state: LifecycleState) -> None:
        """Check that policy, robot and topics match, warm the policy up, connect."""
        settings, topics, spec = self.settings, self.settings.topics, self.policy.spec
        if missing_cameras := sorted(set(spec.cameras) - set(topics.images)):
            names = ", ".join(missing_cameras)
            raise UserError(f"no topic for cameras {names}: add +deploy.topics.images.{missing_cameras[0]}=TOPIC")
        execute = actions_per_plan(self.policy) if getattr(self.policy, "chunking", None) else None
        follows = not settings.dry_run
        loop = ControlLoop(spec, settings.robot, settings.safety, settings.command_hz, follows, execute)
        if settings.gripper is not None and not (loop.goals.has_gripper and topics.gripper):
            raise UserError(
                "deploy/gripper needs a policy that moves a gripper, and its action server in deploy.topics.gripper"
            )
        has_positions = settings.robot.fingers and (settings.command == "joint_state" or topics.gripper)
        if loop.goals.has_gripper and not (settings.gripper or has_positions):
            self.get_logger().warning(
                "the policy moves a gripper, and nothing commands it: set deploy.topics.gripper, with "
                "deploy.robot.fingers or deploy/gripper"
            )
        self._inference = Inference(self.policy)
        self._inference.warm_up()
        self.diagnostics = Diagnostics(self, loop, settings.dry_run)
        Inputs(self, loop, settings, self.diagnostics, self._advance)
        self._arm = ArmOutput(self, loop, settings)
        self._gripper = GripperOutput(self, loop, settings, topics.gripper) if topics.gripper else None
        self._senders = [*self._arm.senders, *(self._gripper.senders if self._gripper else ())]
        self.add_service(Trigger, "~/stop", self._on_stop)
        self.add_service(Trigger, "~/resume", self._on_resume)
        self.add_service(SetBool, "~/hand_over", self._on_hand_over)
        self.loop = loop
        self.diagnostics.report()

    @transition
    def on_activate(self, state: LifecycleState) -> None:
        """Take over the arm at its measured pose."""
        assert self.loop is not None
        self._require_command()
        self.loop.restart()
        self._inference.forget()
        self._last_tick: float | None = None
        self._timers = [
            self.create_timer(self.loop.tick, self.guard(self._tick), clock=self._steady_clock),
            self.create_timer(1.0, self.guard(self._check_publishers), clock=self._steady_clock),
        ]
        super().on_activate(state)

    def _require_command(self) -> None:
        """Raise a UserError if another node commands the arm, or an action server is not there."""
        topic = self._arm.publisher.topic_name
        if (count := self.count_publishers(topic) - 1) > 0:
            raise UserError(f"{count} other publisher(s) on {topic}: stop them first")
        for sender in self._senders:
            sender.prepare()
        if self._gripper:
            self._gripper.reset()

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
        self.created.close()

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
        # The last ones must arrive, even if the node then ends.
        self._arm.publisher.wait_for_all_acked(DELIVERY_TIMEOUT)
        time.sleep(2 * loop.tick if self._senders else 0.0)  # a server is a little behind
        for sender in self._senders:
            sender.cancel()

    def fail(self, reason: str) -> None:
        """Brake and hold until deactivated; the first reason counts."""
        if self.loop is not None and self.loop.state is not State.FAULT:
            self.loop.fail(reason)

    def _on_stop(self, request: Any, response: Any) -> Any:
        response.success = self.active
        if self.loop is None or not self.active:
            response.message = "the agent is not active"
            return response
        self.loop.stop("stopped by request")
        self.diagnostics.report()  # before an instruction is ignored, whose warning this would clear
        return response

    def _on_resume(self, request: Any, response: Any) -> Any:
        loop = self.loop if self.active else None
        running_states = (State.RUNNING, State.HOLDING)  # an instruction that came before has ended a stop by time-out
        response.success = loop is not None and (loop.resume(clock()) or loop.state in running_states)
        response.message = "" if response.success else f"nothing to resume: {loop.reason if loop else 'inactive'}"
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
                loop.take_back(clock())
            response.success = True
            self.diagnostics.report()
        except UserError as error:
            response.message = str(error)
        return response

    def _tick(self) -> None:
        now = clock()
        if self._last_tick is not None:
            self.diagnostics.record("tick", now - self._last_tick)
        self._last_tick = now
        assert self.loop is not None
        for sender in () if self.loop.handed_over else self._senders:
            sender.check()
        self._advance()
        self._send(self.loop)

    def _advance(self) -> None:
        """Schedule a finished inference, and start the next one if it is due."""
        loop, inference = self.loop, self._inference
        assert loop is not None
        try:
            if (result := inference.take()) is not None:
                plan, seconds = result
                loop.drop_overdue(clock())
                follows, delay = loop.set_plan(plan), clock() - loop.observation_time
                if follows:
                    loop.delays.add(delay)
                self.diagnostics.record("inference", seconds)
                self.diagnostics.record("image to command", delay)
        except Exception as error:
            self.get_logger().error(f"the policy failed: {traceback.format_exc()}", throttle_duration_sec=1.0)
            loop.reject_plan(f"the policy failed: {error}")
        if not inference.busy and (observation := loop.next_observation(clock())) is not None:
            inference.start(observation, loop.resumed)

    def _send(self, loop: ControlLoop) -> None:
        """Pass this tick's command on."""
        now = clock()
        if (command := loop.command(now)) is not None:
            self._arm.publish(command, now)
            if self._gripper:
                self._gripper.publish(command)
        self.diagnostics.report_changes()

    def _check_publishers(self) -> None:
        """Fault if another node commands the arm, hold if a camera topic has several publishers; report."""
        assert self.loop is not None
        commands = self._arm.publisher.topic_name
        if self.count_publishers(commands) > 1 and not self.loop.handed_over:
            self.loop.fail(f"another node commands the arm on {commands}")
        topics = {self.resolve_topic_name(self.settings.topics.images[camera]) for camera in self.policy.spec.cameras}
        counts = {topic: self.count_publishers(topic) for topic in sorted(topics)}
        conflicts = [f"{count} publishers send images on {topic}" for topic, count in counts.items() if count > 1]
        self.loop.obstacle = ", ".join(conflicts)
        self.diagnostics.report()
