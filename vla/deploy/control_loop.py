"""State machine between policy and arm: input time-outs, action schedule, joint commands. No ROS.

All times are seconds on one monotonic clock. Shapes: J joints, D action components, k actions of a plan.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from vla.deploy.camera_sync import CameraSync
from vla.deploy.joint_limiter import JointLimiter, Robot
from vla.io.types import Count, Point, Positive
from vla.robots.controllers import GRIPPER, UNITS, controller_for
from vla.spec import Array, Observation, Spec

# How to recover, for messages.
RESUME = 'python -m vla.deploy.say --resume "INSTRUCTION", or call ~/resume'
RESTART = "deactivate and activate the agent, or start it again"
EARLY_SHARE = 0.25  # share of a control period by which an image may precede the next planned inference
HISTORY = 1.0  # duration of the history of joint states and commands [s]


class State(StrEnum):
    """States of a control loop."""

    WAITING = "waiting"  # for a joint state, an image or an instruction; holds the measured pose
    RUNNING = "running"
    HOLDING = "holding"  # an input is late or invalid; runs again after fresh images
    STOPPED = "stopped"  # by request, until resumed; or by time-out, until the next instruction
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
    opening: float  # of the gripper, 0 closed … 1 open


class ControlLoop:
    """Turns images, joint states and instructions into joint commands within limits; not thread-safe."""

    def __init__(self, spec: Spec, robot: Robot, safety: Safety, command_hz: float) -> None:
        """Args: the spec of the policy; the arm; time-outs and limits; commands per second [Hz].

        Raises:
            ValueError: the policy does not fit the arm or the command rate.
        """
        model = spec.require_robot("deployment")
        if others := [name for name in spec.state if name not in model.components]:
            raise ValueError(f"the policy's state has {', '.join(others)}, which joint states do not contain")
        self._controller = controller_for(spec, safety.workspace)
        self._grip = spec.action.index(GRIPPER) if GRIPPER in {*spec.action} - {*model.joints} else None
        self._motion = [index for index in range(len(spec.action)) if index != self._grip]
        self._factors = np.array([UNITS.get(unit.removesuffix("/s"), 1.0) for unit in spec.state_units])
        if len(robot.joints) != len(model.joints):
            raise ValueError(
                f"the policy was trained with {len(model.joints)} joints, the robot has {len(robot.joints)}"
            )
        if command_hz < spec.control_hz:
            raise ValueError(f"command_hz is {command_hz}, below the {spec.control_hz} actions/s of the policy")
        self.spec, self.safety, self.tick = spec, safety, 1 / command_hz
        self._model = model
        self.limiter = JointLimiter(robot, self.tick)
        self.restart()

    def restart(self) -> None:
        """Reset all state; the next joint state becomes the first commanded pose."""
        self.limiter = JointLimiter(self.limiter.robot, self.tick)
        self.state, self.reason = State.WAITING, "no joint state yet"
        self.instruction, self._instructed_at, self._timed_out = "", 0.0, False
        self.overruns, self.rejections = 0, 0
        self._cameras = CameraSync(self.spec.cameras)
        self._measured: deque[tuple[float, Array, Array, float]] = deque()  # at, joints, velocities, opening
        self._commanded: deque[tuple[float, Array]] = deque()  # at, joints
        self._schedule: list[tuple[float, Array, float]] = []  # when due, goal, opening
        self._pending: tuple[float, float, Array] | None = None  # requested at, observed at, commanded then
        self._next_inference, self._opening = -np.inf, 1.0
        self.observed_at = -np.inf  # time stamp of the last observation
        self.resumed = True  # True if the last observation is the first since the loop started to run
        self._last_observed = -np.inf  # as `observed_at`, but reset whenever the loop stops running
        self._off_track_since: float | None = None

    @property
    def robot(self) -> Robot:
        """The arm and its limits."""
        return self.limiter.robot

    # Inputs.

    def on_image(self, camera: str, image: Array, at: float) -> None:
        """Add an image (H, W, 3) uint8 that was taken at `at`."""
        self._cameras.add(camera, image, at)

    def on_joint_state(self, joints: Array, velocities: Array, opening: float, at: float) -> None:
        """Add measured joints (J,) [rad], their velocities [rad/s] and the gripper's opening [m], at `at`."""
        self._measured.append((at, joints, velocities, opening))
        while self._measured[0][0] < at - HISTORY:
            self._measured.popleft()

    def on_instruction(self, instruction: str, now: float) -> bool:
        """Set the instruction, which also ends a stop by time-out; an empty one stops the arm.

        Returns whether the instruction is executed: not after any other stop, nor after a fault.
        """
        if not instruction.strip():
            self.stop("the instruction is empty")
            return False
        self.instruction, self._instructed_at = instruction.strip(), now
        self._schedule, self._next_inference = [], -np.inf
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
        self._set_state(State.HOLDING, "resumed, waiting for fresh images")
        return True

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
        observed = self._cameras.taken_at
        if self.state is not State.RUNNING or self._pending is not None or observed is None:
            return None
        if observed <= self._last_observed or observed < self._next_inference - EARLY_SHARE / self.spec.control_hz:
            return None
        if self._schedule and now > self._schedule[-1][0] + 0.5 / self.spec.control_hz:
            self.overruns += 1
        _, joints, velocities, opening = min(self._measured, key=lambda measured: abs(measured[0] - observed))
        # Anchor on the pose commanded at that time. The measured pose lags behind it; the last goal runs ahead of an
        # arm that its limits slow down, and the policy would overshoot.
        anchor = min(self._commanded, key=lambda command: abs(command[0] - observed))[1]
        self.resumed, self._last_observed, self.observed_at = np.isinf(self._last_observed), observed, observed
        self._pending = (now, observed, anchor)
        return Observation(
            rgb=self._cameras.images,
            state=self._state(joints, velocities, opening),
            instruction=self.instruction,
        )

    def _state(self, joints: Array, velocities: Array, opening: float) -> Array:
        """Robot state (P,) float32 in the order of the spec."""
        model = self._model
        values = dict(zip(model.joints, joints, strict=True)) | dict(zip(model.velocities, velocities, strict=False))
        return np.array([values.get(name, opening) for name in self.spec.state] / self._factors, np.float32)

    def set_plan(self, actions: Array, now: float) -> None:
        """Schedule the policy's actions (k, D); the first one starts at the time of the observation.

        Cartesian actions are relative to the goal of the previous one, the first to the pose commanded at the
        observation; joint positions are absolute. Actions in the past are skipped, but still count towards the goals
        of later ones.
        """
        if self._pending is None:
            return
        _, observed, anchor = self._pending
        self._pending = None
        width = len(self.spec.action)
        if actions.ndim != 2 or actions.shape[1] != width or not len(actions) or not np.isfinite(actions).all():
            return self._count_rejection(
                f"the policy returned {'numbers that are not finite' if actions.ndim == 2 else actions.shape}"
            )
        if self.state is not State.RUNNING:
            return None
        self.rejections = 0
        period = 1 / self.spec.control_hz
        actions = np.clip(actions, self.spec.low, self.spec.high)
        self._controller.reset(anchor)
        goals = [self._controller.step(action[self._motion]).copy() for action in actions]
        openings = [self._opening] * len(actions) if self._grip is None else actions[:, self._grip].tolist()
        ends = observed + period * np.arange(1, len(actions) + 1)
        self._schedule = list(zip(ends.tolist(), goals, openings, strict=True))
        self._next_inference = float(ends[-1])
        return None

    def reject_plan(self, reason: str) -> None:
        """Count a failed inference."""
        self._pending = None
        self._count_rejection(reason)

    # Commands.

    def command(self, now: float) -> Command | None:
        """Return the command of this tick; None before the first joint state."""
        self._supervise(now)
        if not self._commanded:
            return None
        if self.state is State.RUNNING and self._schedule:
            while len(self._schedule) > 1 and self._schedule[0][0] <= now:
                self._schedule.pop(0)
            end, goal, self._opening = self._schedule[0]
            self.limiter.step(goal, end - now)
        else:
            self.limiter.brake()
        self._record(now)
        return Command(self.limiter.position.copy(), self.limiter.velocity.copy(), self._opening)

    def horizon(self, now: float) -> list[Command]:
        """Return the commands after this tick's if no further input arrives; the last one is at rest."""
        limiter = copy.copy(self.limiter)
        commands = []
        schedule = list(self._schedule) if self.state is State.RUNNING else []
        while schedule and now < schedule[-1][0]:
            now += self.tick
            while len(schedule) > 1 and schedule[0][0] <= now:
                schedule.pop(0)
            limiter.step(schedule[0][1], schedule[0][0] - now)
            commands.append(Command(limiter.position.copy(), limiter.velocity.copy(), schedule[0][2]))
        while not limiter.resting or not commands:
            limiter.brake()
            commands.append(Command(limiter.position.copy(), limiter.velocity.copy(), self._opening))
        return commands

    # Supervision.

    def _supervise(self, now: float) -> None:
        """Change the state if an input is missing, late or invalid, or fresh again."""
        if not self._measured:
            return
        measured = self._measured[-1][1]
        if not self._commanded:
            self._take_over(measured, now)
        if self.state in (State.STOPPED, State.FAULT):
            return
        problem = self._input_problem(now)
        if self._off_track(measured, now):
            return self.fail(f"a joint is more than {self.safety.tracking} rad away from its command")
        if not self.instruction:
            return self._set_state(State.WAITING, "no instruction yet")
        if self.safety.instruction is not None and now - self._instructed_at > self.safety.instruction:
            self.stop(f"time-out: {self.safety.instruction:g} s on one instruction", "send the next instruction")
            self._timed_out = True
            return None
        if problem:
            self._cameras.fresh = 0
            return self._set_state(State.HOLDING if self.state is State.RUNNING else self.state, problem)
        recovered = self.state is State.HOLDING and self._cameras.fresh >= self.safety.fresh_frames
        if self.state is State.WAITING or recovered:
            self._set_state(State.RUNNING, "")
        return None

    def _take_over(self, measured: Array, now: float) -> None:
        try:
            self.limiter.start(measured)
        except ValueError as error:
            return self.fail(str(error))
        stroke = max(self.robot.finger_travel * len(self.robot.fingers), 1e-6)
        self._opening = float(np.clip(self._measured[-1][3] / stroke, 0.0, 1.0))
        return self._record(now)

    def _input_problem(self, now: float) -> str:
        """Describe which input or inference is overdue; empty if none is."""
        if problem := self._cameras.problem(now, self.safety.image_age):
            return problem
        if now - self._measured[-1][0] > self.safety.joints_age:
            return f"the newest joint state is older than {self.safety.joints_age} s"
        if self._pending is not None and now - self._pending[0] > self.safety.inference:
            return f"inference takes longer than {self.safety.inference} s"
        return ""

    def _off_track(self, measured: Array, now: float) -> bool:
        """Return whether the tracking error has exceeded its limit for too long."""
        outdated = now - self._measured[-1][0] > self.safety.joints_age
        if outdated or np.abs(self.limiter.position - measured).max() <= self.safety.tracking:
            self._off_track_since = None
        elif self._off_track_since is None:
            self._off_track_since = now
        return self._off_track_since is not None and now - self._off_track_since > self.safety.tracking_for

    def _count_rejection(self, reason: str) -> None:
        self.rejections += 1
        if self.rejections >= self.safety.rejected:
            self.fail(f"{reason}, {self.rejections} times in a row")
        else:
            self.hold(reason)

    def _set_state(self, state: State, reason: str) -> None:
        if state is not self.state and state is not State.RUNNING:
            self._cameras.fresh, self._schedule = 0, []
            self._next_inference = self._last_observed = -np.inf
        self.state, self.reason = state, reason

    def _record(self, now: float) -> None:
        self._commanded.append((now + self.tick, self.limiter.position.copy()))
        while self._commanded[0][0] < now - HISTORY:
            self._commanded.popleft()
