"""State machine between policy and arm: input time-outs, action schedule, joint commands. No ROS.

All times are seconds on one monotonic clock. Shapes: J joints, D action components, k actions of a plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vla.deploy.joint_limiter import JointLimits
from vla.deploy.motion import Command, Goals, Motion
from vla.deploy.observer import Observer
from vla.deploy.safety import Safety, State, Tracking
from vla.io.errors import UserError
from vla.schedule import Delays
from vla.spec import Array, Observation, RunningPlan, Spec

# How to recover, for messages.
RESUME = 'python -m vla.deploy.say --resume "INSTRUCTION", or call ~/resume'
RESTART = "deactivate and activate the agent, or start it again"
HAND_BACK = "python -m vla.deploy.say --hand-back, or call ~/hand_over with false"
REPETITION_TIME = 2.0  # an equal instruction within this time is a repetition, as `ros2 topic pub` sends them [s]
REST_MOTION, REST_TIME = 0.005, 0.2  # an arm that has moved less [rad] for so long [s] is at rest
JUMP = 0.1  # largest motion between two joint states beyond what the speed of the joint explains [rad]


@dataclass
class _Request:
    """An inference under way."""

    since: float
    observed: float  # time stamp of its observation
    anchor: Array  # (J,) joints from which Cartesian actions start
    outdated: bool = False  # its plan must not be executed


class ControlLoop:
    """Turns images and joint states, which its `observer` is given, and instructions into joint commands within limits;
    not thread-safe."""

    def __init__(
        self,
        spec: Spec,
        limits: JointLimits,
        safety: Safety,
        command_hz: float,
        follows_positions: bool = True,
        execute: int | None = None,
    ) -> None:
        """Args:
        spec: of the policy.
        limits: of the arm.
        safety: time-outs and limits.
        command_hz: commands per second [Hz].
        follows_positions: whether the arm follows the commands. Otherwise, as in a dry run, the commands of every plan
            start at the measured pose.
        execute: number of actions of a plan after which the next one, which continues it, is requested; None: all.

        Raises:
            UserError: the policy does not fit the arm or the command rate.
        """
        if command_hz < spec.control_hz:
            raise UserError(f"deploy.command_hz={command_hz} must be at least the policy's {spec.control_hz} actions/s")
        self.goals = Goals(spec, limits, safety.workspace)
        self.spec, self.limits, self.safety, self.tick = spec, limits, safety, 1 / command_hz
        self._follows_positions, self._execute = follows_positions, execute
        self.restart()

    def restart(self) -> None:
        """Reset all state; the next joint state becomes the first commanded pose."""
        self.state, self.reason = State.WAITING, "no joint state yet"
        self.instruction, self._instructed_at, self._said_at = "", 0.0, -np.inf
        self.late_plans, self.rejections, self.handed_over = 0, 0, False
        self.obstacle = ""  # external reason to hold the arm until this is empty again
        self.motion = Motion(self.limits, self.tick, 1 / self.spec.control_hz, self.goals.workspace)
        self.observer, self._tracking = Observer(self.spec), Tracking(self.safety, self._follows_positions)
        self._request: _Request | None = None
        self._planned = np.empty((0, len(self.spec.action)), np.float32)  # the actions in the schedule
        self.delays = Delays(1 / self.spec.control_hz)  # from observations to their plans
        self.observation_time = -np.inf  # time stamp of the last observation
        self.resumed = True  # True if the last observation is the first since the loop started to run
        self._last_observed = -np.inf  # as `observation_time`, but reset whenever the loop stops running
        self._timed_out = False  # True if the loop is stopped by a time-out

    def on_instruction(self, instruction: str, now: float) -> bool:
        """Set the instruction, which also ends a stop by time-out; an empty one stops the arm.

        An equal one within `REPETITION_TIME` of the last is a repetition and changes nothing.

        Returns whether the instruction is executed: not after any other stop, nor after a fault.
        """
        instruction = instruction.strip()
        if not instruction:
            self.stop("the instruction is empty")
            return False
        is_repetition = instruction == self.instruction and now - self._said_at < REPETITION_TIME
        self._said_at = now
        if not is_repetition:
            self.instruction, self._instructed_at = instruction, now
            self._drop_plans()
            if self.state is State.STOPPED and self._timed_out:
                self.resume(now)
        return self.state not in (State.STOPPED, State.FAULT)

    def stop(self, reason: str, recovery: str = RESUME) -> None:
        """Brake and hold until resumed; `recovery` describes how."""
        if self.state is not State.FAULT:
            self._timed_out = False
            self._set_state(State.STOPPED, f"{reason}; to continue: {recovery}")

    def resume(self, now: float) -> bool:
        """Continue after a stop; returns False if the loop is not stopped."""
        if self.state is not State.STOPPED:
            return False
        self._instructed_at = now
        self._wait_to_run("resumed")
        return True

    def hand_over(self) -> None:
        """Leave the arm, which must be at rest, to a person; nothing is commanded from now on."""
        self.handed_over, self._request = True, None
        if self.state not in (State.STOPPED, State.FAULT):
            self._wait_to_run("")

    def take_back(self, now: float) -> None:
        """Command the arm again, from its measured pose; the gripper stays as it is until the policy moves it. Raises a
        UserError if the arm moves, is outside its limits, or has no recent joint state; the person then keeps it."""
        joint_state = self.observer.newest_joint_state
        if (problem := self._joints_problem(now) or self._history_problem()) or joint_state is None:
            raise UserError(problem)
        if self.observer.displacement(REST_TIME) > REST_MOTION:
            raise UserError("the arm still moves: let it rest first")
        self.motion.start(joint_state.joints, now)
        self._tracking = Tracking(self.safety, self._follows_positions)
        self.handed_over, self._instructed_at = False, now
        if self.state is State.HANDED_OVER:
            self._wait_to_run("handed back")

    def fail(self, reason: str) -> None:
        """Brake and hold until deactivated."""
        self._set_state(State.FAULT, f"{reason}; to continue: {RESTART}")

    def hold(self, reason: str) -> None:
        """Brake and hold until the images are fresh again."""
        if self.state in (State.WAITING, State.RUNNING, State.HOLDING):
            self._set_state(State.HOLDING, reason)

    def _wait_to_run(self, reason: str) -> None:
        """Enter HANDED_OVER while a person moves the arm, otherwise HOLDING until the images are fresh."""
        if self.handed_over:
            self._set_state(State.HANDED_OVER, f"a person moves the arm; to continue: {HAND_BACK}")
        else:
            self._set_state(State.HOLDING, f"{reason}, waiting for fresh images")

    def next_observation(self, now: float) -> Observation | None:
        """Return the observation for the policy if an inference is due; then call `set_plan` or `reject_plan`."""
        schedule = self.motion.schedule
        image_time = self.observer.new_image_time(
            self._last_observed, schedule.end if self._execute is None else schedule.execution_end(self._execute)
        )
        if self.state is not State.RUNNING or self._request is not None or image_time is None:
            return None
        if schedule.newest_plan and now > schedule.end + 0.5 / self.spec.control_hz:
            self.late_plans += 1
        # Anchor on the pose commanded at that time. The measured pose lags behind it; the last goal runs ahead of an
        # arm that its limits slow down, and the policy would overshoot.
        measured = self.observer.joint_state_at(image_time)
        anchor = self.motion.commanded_joints(image_time) if self._follows_positions else measured.joints
        self.resumed, self._last_observed, self.observation_time = np.isinf(self._last_observed), image_time, image_time
        self._request = _Request(now, image_time, anchor)
        observation = Observation(self.observer.images, self.observer.state(measured), self.instruction)
        steps_left = len(schedule.remaining_actions(image_time + 0.5 / self.spec.control_hz))  # an image may be early
        if self._execute is None or not steps_left:
            return observation
        return replace(
            observation, running=RunningPlan(self._planned[-steps_left:], min(self.delays.forecast, steps_left))
        )

    def set_plan(self, actions: Array) -> bool:
        """Schedule the policy's actions (k, D); the first one starts at the time of the observation.

        Returns whether the arm follows them: not if they are unusable or outdated, or the loop is not running.

        Actions in the past are skipped, but still count towards the goals of later Cartesian ones.
        """
        request, self._request = self._request, None
        if request is None:  # the arm has been handed over in the meantime
            return False
        try:
            waypoints = self.goals.waypoints(actions, request.observed, request.anchor)
        except UserError as error:
            self._count_rejection(str(error))
            return False
        if follows := self.state is State.RUNNING and not request.outdated:
            self.rejections, self._planned = 0, actions
            # An arm that does not follow its commands is where it is measured, not where it was commanded.
            joint_state = None if self._follows_positions else self.observer.newest_joint_state
            self.motion.follow(waypoints, None if joint_state is None else joint_state.joints)
        return follows

    def drop_overdue(self, now: float) -> None:
        """Hold if the inference under way is overdue, so that its plan is not followed even if nobody looked before."""
        if problem := self._inference_problem(now):
            self.hold(problem)

    def reject_plan(self, reason: str) -> None:
        """Count a failed inference, unless the arm has been handed over since it began."""
        if self._request is not None:
            self._request = None
            self._count_rejection(reason)

    def _count_rejection(self, reason: str) -> None:
        self.rejections += 1
        if self.rejections >= self.safety.rejected:
            self.fail(f"{reason}, {self.rejections} times in a row")
        else:
            self.hold(reason)

    def command(self, now: float) -> Command | None:
        """Return the command of this tick; None before the first joint state, and while a person moves the arm."""
        if self.handed_over:
            return None
        self._supervise(now)
        return self.motion.advance(now) if self.motion.started else None

    @property
    def acting(self) -> bool:
        """Whether the arm executes actions of the policy."""
        return self.motion.schedule.newest_plan is not None

    def _supervise(self, now: float) -> None:
        """Change the state if an input is missing, late or invalid, or fresh again."""
        joint_state = self.observer.newest_joint_state
        if joint_state is None:
            return
        if not self.motion.started and self.state is not State.FAULT:  # after which a person must inspect the arm
            # The arm may be elsewhere by now, or one of two sources of joint states may not have been heard yet.
            if problem := self._joints_problem(now) or self._history_problem():
                return None if self.state is State.STOPPED else self._set_state(self.state, problem)
            try:
                self.motion.start(joint_state.joints, now)
            except UserError as error:
                self.fail(str(error))
        off_track, moved_unseen = self._tracking.check(self.motion, joint_state, now)
        if moved_unseen or (off_track and self._must_stay):
            # The earlier commanded pose is dropped, because the arm would rush back to it.
            self.motion.hold(joint_state.joints)
            if self.state is not State.FAULT:
                self.fail("the arm was moved while it was held")
        if self.state in (State.STOPPED, State.FAULT):
            return
        if off_track:
            self.fail(f"a joint is more than {self.safety.tracking} rad away from its command")
        elif not self.instruction:
            self._set_state(State.WAITING, "no instruction yet")
        elif self.safety.instruction is not None and now - self._instructed_at > self.safety.instruction:
            self.stop(f"time-out: {self.safety.instruction:g} s on one instruction", "send the next instruction")
            self._timed_out = True
        elif problem := self._input_problem(now):
            # A held arm moves again only after consecutive fresh frames.
            self.observer.fresh_sets = 0
            self._set_state(State.HOLDING if self.state is State.RUNNING else self.state, problem)
        elif self.state is State.WAITING or self.observer.fresh_sets >= self.safety.fresh_frames:
            self._set_state(State.RUNNING, "")

    @property
    def _must_stay(self) -> bool:
        """Whether the arm is to stay where it is; after a fault it may still be on its way to rest."""
        resting = self.motion.limiter.resting and self.observer.displacement(REST_TIME) <= REST_MOTION
        return self.state is State.STOPPED or (self.state is State.FAULT and resting)

    def _input_problem(self, now: float) -> str:
        """Describe which input or inference is overdue; empty if none is."""
        if problem := self.obstacle or self.observer.image_problem(now, self.safety.image_age):
            return problem
        if problem := self._joints_problem(now):
            return problem
        return self._inference_problem(now)

    def _inference_problem(self, now: float) -> str:
        overdue = self._request is not None and now - self._request.since > self.safety.inference
        return f"inference takes longer than {self.safety.inference} s" if overdue else ""

    def _joints_problem(self, now: float) -> str:
        """Say that the newest joint state is too old, or that there is none, or that joint states jump; else ""."""
        joint_state = self.observer.newest_joint_state
        if joint_state is None or now - joint_state.stamp > self.safety.joints_age:
            return f"no joint state within the last {self.safety.joints_age} s"
        if self.observer.jump(REST_TIME, np.array(self.limits.speed)) > JUMP:
            return "the joint states jump: does another node publish on the topic deploy.topics.joint_states, too?"
        return ""

    def _history_problem(self) -> str:
        """Say that joint states have not come for long enough to tell whether they agree; else ""."""
        return "" if self.observer.duration >= REST_TIME else f"less than {REST_TIME} s of joint states"

    def _set_state(self, state: State, reason: str) -> None:
        if state is not self.state:
            self._drop_plans()
            if state is not State.RUNNING:  # when it runs again, the policy begins anew with the newest frame
                self.observer.fresh_sets, self._last_observed = 0, -np.inf
        self.state, self.reason = state, reason

    def _drop_plans(self) -> None:
        """Brake until the next plan, and ignore an inference under way, whose observation is outdated."""
        self.motion.follow([])
        if self._request is not None:
            self._request.outdated = True
