"""State machine between policy and arm: input time-outs, action schedule, joint commands. No ROS.

All times are seconds on one monotonic clock. Shapes: J joints, D action components, k actions of a plan.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from vla.deploy.joint_limiter import JointLimiter, Robot
from vla.deploy.observer import HISTORY, Measured, Observer
from vla.deploy.workspace import Workspace
from vla.io.errors import UserError
from vla.io.types import Count, Point, Positive
from vla.robots.cartesian import CartesianController
from vla.robots.controllers import controller_for, gripper_index
from vla.schedule import Schedule
from vla.spec import Array, Observation, Spec

Waypoint = tuple[float, Array, float | None]  # when due, goal of the joints, opening

# How to recover, for messages.
RESUME = 'python -m vla.deploy.say --resume "INSTRUCTION", or call ~/resume'
RESTART = "deactivate and activate the agent, or start it again"
HAND_BACK = "python -m vla.deploy.say --hand-back, or call ~/hand_over with false"
REPEATED = 2.0  # an equal instruction within this time is a repetition, as `ros2 topic pub` sends them [s]
STILL, STILL_FOR = 0.005, 0.2  # an arm that has moved less [rad] for so long [s] is at rest


class State(StrEnum):
    """States of a control loop."""

    WAITING = "waiting"  # for a joint state, an image or an instruction; holds the measured pose
    RUNNING = "running"
    HOLDING = "holding"  # an input is late or invalid; runs again after fresh images
    STOPPED = "stopped"  # by request, until resumed; or by time-out, until the next instruction
    HANDED_OVER = "handed over"  # a person moves the arm, until it is handed back; commands nothing
    FAULT = "fault"  # needs inspection; until deactivated


@dataclass(frozen=True)
class Safety:
    """Time-outs and limits that hold or stop the arm."""

    image_age: Positive  # oldest image to act on [s]
    joints_age: Positive  # oldest joint state to act on [s]
    inference: Positive  # longest duration of an inference [s]
    instruction: Positive | None  # longest time to execute one instruction [s]; None: unlimited
    tracking: Positive  # largest tracking error of a joint [rad] …
    tracking_for: Positive  # … for so long [s]
    fresh_frames: Count  # consecutive matching sets of images after which a held arm moves again
    rejected: Count  # consecutive rejected plans that cause a fault
    # opposite corners of the box for the tool point, in the base frame [m]; None for joint positions as actions
    workspace: tuple[Point, Point] | None


@dataclass(frozen=True)
class Command:
    """Joint targets for the end of a tick."""

    position: Array  # (J,) [rad]
    velocity: Array  # (J,) [rad/s]
    opening: float | None  # of the gripper, 0 closed … 1 open; None leaves it as it is


class ControlLoop:
    """Turns images, joint states and instructions into joint commands within limits; not thread-safe."""

    def __init__(
        self, spec: Spec, robot: Robot, safety: Safety, command_hz: float, follows_positions: bool = True
    ) -> None:
        """Args:
        spec: of the policy.
        robot: the arm.
        safety: time-outs and limits.
        command_hz: commands per second [Hz].
        follows_positions: whether the arm goes where the commands say. Otherwise it goes its own way, as in a dry run,
            and the commands of every plan start at the measured pose.

        Raises:
            UserError: the policy does not fit the arm or the command rate.
        """
        model = spec.require_robot("deployment")
        if len(robot.joints) != len(model.joints):
            raise UserError(
                f"the policy was trained with {len(model.joints)} joints, the robot has {len(robot.joints)}"
            )
        limits = robot.min_position, robot.max_position, np.array(robot.speed)
        self._controller = controller = controller_for(spec, safety.workspace, limits)
        self._workspace = None
        if isinstance(controller, CartesianController):
            self._workspace = Workspace(controller.arm.forward, controller.low, controller.high)
        self._gripper_index = gripper_index(spec)
        self.has_gripper = self._gripper_index is not None
        self._motion = [index for index in range(len(spec.action)) if index != self._gripper_index]
        if model.gripper in spec.state and not robot.fingers:
            raise UserError("the policy sees how far its gripper is open: name the joints in deploy.robot.fingers")
        if command_hz < spec.control_hz:
            raise UserError(f"command_hz is {command_hz}, below the {spec.control_hz} actions/s of the policy")
        self.spec, self.safety, self.tick = spec, safety, 1 / command_hz
        self._follows_positions = follows_positions
        self.limiter = JointLimiter(robot, self.tick)
        self.restart()

    def restart(self) -> None:
        """Reset all state; the next joint state becomes the first commanded pose."""
        self.limiter = JointLimiter(self.limiter.robot, self.tick)
        self.state, self.reason = State.WAITING, "no joint state yet"
        self.instruction, self._instructed_at, self._timed_out = "", 0.0, False
        self._said_at = -np.inf
        self.late_plans, self.rejections = 0, 0
        self.handed_over = False
        self._observer = Observer(self.spec)
        self._commanded: deque[tuple[float, Array]] = deque()  # at, joints
        self._schedule = Schedule[Waypoint](1 / self.spec.control_hz)
        self._pending: tuple[float, float, Array] | None = None  # requested at, observed at, commanded then
        self._outdated = False  # True if what is pending is not to be executed
        self._opening: float | None = 1.0
        self.acting = False  # True if the last command is an action of the policy
        # Trajectory that the arm executes by itself: since when, its commands.
        self._sent: tuple[float, list[Command]] | None = None
        self._sent_valid = False  # True until something changes
        self.observed_at = -np.inf  # time stamp of the last observation
        self.resumed = True  # True if the last observation is the first since the loop started to run
        self._last_observed = -np.inf  # as `observed_at`, but reset whenever the loop stops running
        self._off_track_since: float | None = None
        self._lost = False  # True if the newest joint state was too old at the last tick

    @property
    def robot(self) -> Robot:
        """The arm and its limits."""
        return self.limiter.robot

    # Inputs.

    def on_image(self, camera: str, image: Array, at: float) -> None:
        """Add an image (H, W, 3) uint8 that was taken at `at`."""
        self._observer.cameras.add(camera, image, at)

    def on_joint_state(self, joints: Array, velocities: Array, opening: float, at: float) -> None:
        """Add measured joints (J,) [rad], their velocities [rad/s] and the gripper's opening [m], at `at`."""
        self._observer.on_joint_state(Measured(at, joints, velocities, opening))

    def on_instruction(self, instruction: str, now: float) -> bool:
        """Set the instruction, which also ends a stop by time-out; an empty one stops the arm.

        An equal one within `REPEATED` of the last is a repetition and changes nothing.

        Returns whether the instruction is executed: not after any other stop, nor after a fault.
        """
        if not instruction.strip():
            self.stop("the instruction is empty")
            return False
        repeated = instruction.strip() == self.instruction and now - self._said_at < REPEATED
        self._said_at = now
        if repeated:
            return self.state not in (State.STOPPED, State.FAULT)
        self.instruction, self._instructed_at = instruction.strip(), now
        self._schedule.clear()
        self._sent_valid, self._outdated = False, True
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
        """Leave the arm, which is to be at rest, to a person; nothing is commanded from now on."""
        self.handed_over, self._pending = True, None
        if self.state not in (State.STOPPED, State.FAULT):
            self._wait_to_run("")

    def take_back(self, now: float) -> None:
        """Command the arm again, from its measured pose; the gripper is left as it is until the policy moves it.

        Raises:
            UserError: the arm moves, is outside its limits, or has no recent joint state; the person keeps it.
        """
        measured = self._observer.newest
        if measured is None or now - measured.at > self.safety.joints_age:
            raise UserError(f"the newest joint state is older than {self.safety.joints_age} s")
        if self._observer.moved(STILL_FOR) > STILL:
            raise UserError("the arm still moves: let it rest first")
        self.limiter.start(measured.joints)
        self._sent, self._sent_valid = None, False
        self._commanded.clear()
        self._record(now)
        self.handed_over, self._opening, self._off_track_since = False, None, None
        self._instructed_at = now
        if self.state is State.HANDED_OVER:
            self._wait_to_run("handed back")

    def _wait_to_run(self, why: str) -> None:
        """Enter HANDED_OVER while a person moves the arm, otherwise HOLDING until the images are fresh."""
        if self.handed_over:
            self._set_state(State.HANDED_OVER, f"a person moves the arm; to continue: {HAND_BACK}")
        else:
            self._set_state(State.HOLDING, f"{why}, waiting for fresh images")

    def fail(self, reason: str) -> None:
        """Brake and hold until deactivated."""
        self._set_state(State.FAULT, f"{reason}; to continue: {RESTART}")

    def hold(self, reason: str) -> None:
        """Brake and hold until the images are fresh again."""
        if self.state in (State.WAITING, State.RUNNING, State.HOLDING):
            self._set_state(State.HOLDING, reason)

    # Inference.

    def next_observation(self, now: float) -> Observation | None:
        """Return the observation for the policy if an inference is due; then call `set_plan` or `reject_plan`."""
        observed = self._observer.due(self._last_observed, self._schedule.end)
        if self.state is not State.RUNNING or self._pending is not None or observed is None:
            return None
        if self._schedule.newest and now > self._schedule.end + 0.5 / self.spec.control_hz:
            self.late_plans += 1
        # Anchor on the pose commanded at that time. The measured pose lags behind it; the last goal runs ahead of an
        # arm that its limits slow down, and the policy would overshoot.
        anchor = min(self._commanded, key=lambda command: abs(command[0] - observed))[1]
        if not self._follows_positions:
            anchor = self._observer.measured_at(observed).joints
        self.resumed, self._last_observed, self.observed_at = np.isinf(self._last_observed), observed, observed
        self._pending, self._outdated = (now, observed, anchor), False
        return self._observer.observation(observed, self.instruction)

    def set_plan(self, actions: Array) -> None:
        """Schedule the policy's actions (k, D); the first one starts at the time of the observation.

        Cartesian actions are relative to the goal of the previous one, the first to the pose commanded at the
        observation; joint positions are absolute. Actions in the past are skipped, but still count towards the goals
        of later ones.
        """
        if self._pending is None:
            return
        _, observed, anchor = self._pending
        self._pending = None
        if actions.ndim != 2 or not len(actions) or actions.shape[1] != len(self.spec.action):
            return self._count_rejection(f"the policy returned actions of the shape {actions.shape}")
        if not np.isfinite(actions).all():
            return self._count_rejection("the policy returned numbers that are not finite")
        if self.state is not State.RUNNING or self._outdated:
            return None
        self.rejections = 0
        period = 1 / self.spec.control_hz
        actions = np.clip(actions, self.spec.low, self.spec.high)
        self._controller.reset(anchor)
        goals = [self._controller.step(action[self._motion]).copy() for action in actions]
        openings = [self._opening] * len(actions)
        if self._gripper_index is not None:  # bounds that follow from data may be beyond 0 and 1
            openings = np.clip(actions[:, self._gripper_index], 0, 1).tolist()
        if not self._follows_positions and (measured := self._observer.newest) is not None:
            self.limiter.position = np.array(measured.joints, float)
        ends = observed + period * np.arange(1, len(actions) + 1)
        self._schedule.add(list(zip(ends.tolist(), goals, openings, strict=True)), observed)
        self._sent_valid = False
        return None

    def reject_plan(self, reason: str) -> None:
        """Count a failed inference, unless the arm has been handed over since it began."""
        if self._pending is None:
            return
        self._pending = None
        self._count_rejection(reason)

    # Commands.

    def command(self, now: float) -> Command | None:
        """Return the command of this tick; None before the first joint state, and while a person moves the arm."""
        if self.handed_over:
            return None
        self._supervise(now)
        if not self._commanded:
            return None
        self.acting = self.state is State.RUNNING and self._schedule.newest is not None
        if self._sent is not None:
            self._follow_sent(*self._sent, now)
        if not self._sent_valid:
            self._move(now)
        self._record(now)
        return Command(self.limiter.position.copy(), self.limiter.velocity.copy(), self._opening)

    def _move(self, now: float) -> None:
        """Take this tick's step along the schedule, or brake."""
        if not self.acting:
            self.limiter.brake()
            return
        end, goal, self._opening = self._waypoint(now)
        self._step(self.limiter, goal, end - now)

    def _waypoint(self, now: float) -> Waypoint:
        """Return what is due next: until the next plan arrives, the last of the newest plan."""
        assert self._schedule.newest is not None
        return (self._schedule.at(now) or [self._schedule.newest.actions[-1]])[-1]

    def _step(self, limiter: JointLimiter, goal: Array, remaining: float) -> None:
        """Move towards a goal that is due in `remaining` seconds, within the limits and the workspace."""
        if self._workspace is None:
            limiter.step(goal, remaining)
        else:
            self._workspace.step(limiter, goal, remaining)

    def horizon(self, now: float, longest: float = math.inf) -> list[Command]:
        """Return the commands after this tick's if no further input arrives; the last one is at rest.

        Args:
            now: the time of this tick [s].
            longest: time [s] after which the arm brakes, if the plan has not ended before.
        """
        limiter, opening = copy.copy(self.limiter), self._opening
        commands, until = [], now + longest
        while self.state is State.RUNNING and now < min(self._schedule.end, until):
            now += self.tick
            end, goal, opening = self._waypoint(now)
            self._step(limiter, goal, end - now)
            commands.append(Command(limiter.position.copy(), limiter.velocity.copy(), opening))
        while not limiter.resting or not commands:
            limiter.brake()
            commands.append(Command(limiter.position.copy(), limiter.velocity.copy(), opening))
        return commands

    def commit(self, command: Command, now: float) -> list[Command] | None:
        """Return the trajectory from this command to rest, for an arm that executes it by itself.

        None if the trajectory that was sent last is still valid.
        """
        if self._sent_valid:
            return None
        ahead = [command, *self.horizon(now)]
        self._sent, self._sent_valid = (now, ahead), True
        return ahead

    def _follow_sent(self, since: float, ahead: list[Command], now: float) -> None:
        """Set the commanded state from the trajectory `ahead`, sent at `since`.

        It is that of this tick while the trajectory is valid, else that of the previous tick, because `_move` follows.
        """
        ticks = round((now - since) / self.tick) - (not self._sent_valid)
        planned = ahead[min(max(ticks, 0), len(ahead) - 1)]
        self.limiter.position, self.limiter.velocity = planned.position.copy(), planned.velocity.copy()
        self._opening = planned.opening

    def tool_velocity(self, command: Command) -> Array:
        """Return the (6,) velocity of the tool [m/s], [rad/s] in the base frame, of a Cartesian policy's command."""
        assert isinstance(self._controller, CartesianController)
        _, jacobian = self._controller.arm.forward(command.position)
        return jacobian @ command.velocity

    def limit(self, robot: Robot) -> None:
        """Replace the limits."""
        self.limiter.robot, self._sent_valid = robot, False

    # Supervision.

    def _supervise(self, now: float) -> None:
        """Change the state if an input is missing, late or invalid, or fresh again."""
        newest = self._observer.newest
        if newest is None:
            return
        if not self._commanded and self.state is not State.FAULT:
            self._take_over(newest, now)
        off_track, lost, self._lost = self._off_track(newest, now), self._lost, now - newest.at > self.safety.joints_age
        returned = lost and not self._lost and self._away(newest)
        halted = self.state is State.STOPPED or (
            self.state is State.FAULT and self.limiter.resting and self._observer.moved(STILL_FOR) <= STILL
        )
        if returned or (off_track and halted):
            self._hold_measured(newest)
            if self.state is not State.FAULT:
                self.fail("the arm was moved while it was held")
        if self.state in (State.STOPPED, State.FAULT):
            return None
        problem = self._input_problem(newest, now)
        if off_track:
            return self.fail(f"a joint is more than {self.safety.tracking} rad away from its command")
        if not self.instruction:
            return self._set_state(State.WAITING, "no instruction yet")
        if self.safety.instruction is not None and now - self._instructed_at > self.safety.instruction:
            self.stop(f"time-out: {self.safety.instruction:g} s on one instruction", "send the next instruction")
            self._timed_out = True
            return None
        if problem:
            self._observer.cameras.fresh = 0
            return self._set_state(State.HOLDING if self.state is State.RUNNING else self.state, problem)
        recovered = self.state is State.HOLDING and self._observer.cameras.fresh >= self.safety.fresh_frames
        if self.state is State.WAITING or recovered:
            self._set_state(State.RUNNING, "")
        return None

    def _hold_measured(self, measured: Measured) -> None:
        """Command the measured pose, so that an arm that is elsewhere is not pulled back."""
        self.limiter.position, self.limiter.velocity = measured.joints.copy(), np.zeros(len(measured.joints))
        self._sent, self._sent_valid = None, False

    def _take_over(self, measured: Measured, now: float) -> None:
        try:
            self.limiter.start(measured.joints)
        except ValueError as error:
            return self.fail(str(error))
        self._opening = float(np.clip(measured.opening / self.robot.stroke, 0.0, 1.0))
        return self._record(now)

    def _input_problem(self, newest: Measured, now: float) -> str:
        """Describe which input or inference is overdue; empty if none is."""
        if problem := self._observer.cameras.problem(now, self.safety.image_age):
            return problem
        if now - newest.at > self.safety.joints_age:
            return f"the newest joint state is older than {self.safety.joints_age} s"
        if self._pending is not None and now - self._pending[0] > self.safety.inference:
            return f"inference takes longer than {self.safety.inference} s"
        return ""

    def _off_track(self, newest: Measured, now: float) -> bool:
        """Return whether the tracking error has exceeded its limit for too long."""
        if now - newest.at > self.safety.joints_age or not self._away(newest):
            self._off_track_since = None
        elif self._off_track_since is None:
            self._off_track_since = now
        return self._off_track_since is not None and now - self._off_track_since > self.safety.tracking_for

    def _away(self, newest: Measured) -> bool:
        """Return whether the arm is further from its command than the tracking error may be."""
        error = np.abs(self.limiter.position - newest.joints).max()
        return bool(self._commanded) and self._follows_positions and bool(error > self.safety.tracking)

    def _count_rejection(self, reason: str) -> None:
        self.rejections += 1
        if self.rejections >= self.safety.rejected:
            self.fail(f"{reason}, {self.rejections} times in a row")
        else:
            self.hold(reason)

    def _set_state(self, state: State, reason: str) -> None:
        if state is not self.state:
            self._sent_valid = False
        if state is not self.state and state is not State.RUNNING:
            self._schedule.clear()
            self._observer.cameras.fresh, self._outdated, self._last_observed = 0, True, -np.inf
        self.state, self.reason = state, reason

    def _record(self, now: float) -> None:
        self._commanded.append((now + self.tick, self.limiter.position.copy()))
        while self._commanded[0][0] < now - HISTORY:
            self._commanded.popleft()
