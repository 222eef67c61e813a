"""What the arm may do now: what it saw and was told, how fresh that is, and the command that follows. No ROS.

All times are seconds on one clock that never stops. Shapes: J joints, D action components, k actions of a plan.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from vla.deploy.frames import Frames
from vla.deploy.governor import Governor, Robot
from vla.spec import Array, Observation, Spec
from vla.tasks.control import WORKSPACE, CartesianController
from vla.types import Count, Positive

# The ways out.
RESUME = 'python -m vla.deploy.say --resume "INSTRUCTION", or call ~/resume'
RESTART = "deactivate and activate the agent, or start it again"
ACTION = ("dx", "dy", "dz", "rx", "ry", "rz", "gripper")
EARLY = 0.25  # share of a control period that a frame may come early and still be the one to act on
MEMORY = 1.0  # how long joint states and commands are remembered [s]


class State(StrEnum):
    """What a session is doing."""

    WAITING = "waiting"  # for an arm, an image or an instruction; holds the pose it found
    RUNNING = "running"
    HOLDING = "holding"  # something is late or wrong; runs again when frames are fresh
    STOPPED = "stopped"  # somebody said so, until resumed; or the time is up, until the next instruction
    FAULT = "fault"  # something must be looked at; until deactivated


@dataclass(frozen=True)
class Safety:
    """When to hold and when to give up; None switches a limit off."""

    image_age: Positive = 0.3  # oldest image to act on [s]
    joints_age: Positive = 0.2  # oldest joint state [s]
    inference: Positive = 0.3  # longest wait for the policy [s]
    instruction: Positive | None = 60.0  # longest time to work on one instruction [s]
    tracking: Positive = 0.2  # largest distance of a joint from its command [rad] …
    tracking_for: Positive = 0.5  # … for so long [s]
    fresh_frames: Count = 3  # frames of all cameras in a row after which a held session runs again
    rejected: Count = 3  # unusable plans in a row that make a fault


@dataclass(frozen=True)
class Command:
    """Where the arm should be at the end of this tick."""

    position: Array  # (J,) [rad]
    velocity: Array  # (J,) [rad/s]
    opening: float  # of the gripper, 0 closed … 1 open


class Session:
    """From frames, joint states and words to commands within limits; every method belongs to one thread."""

    def __init__(self, spec: Spec, robot: Robot, safety: Safety, command_hz: float) -> None:
        """Args: what the policy was trained on; the arm; the limits; commands per second.

        Raises:
            ValueError: the arm cannot do what the policy was trained to do.
        """
        if spec.action != ACTION:
            raise ValueError(f"the policy acts with {', '.join(spec.action)}, an arm is moved by {', '.join(ACTION)}")
        if len(robot.joints) != len(spec.joints):
            raise ValueError(f"the policy knows {len(spec.joints)} joints, the robot has {len(robot.joints)}")
        if command_hz < spec.control_hz:
            raise ValueError(f"command_hz is {command_hz}, less than the {spec.control_hz} actions/s of the policy")
        self.spec, self.safety, self.tick = spec, safety, 1 / command_hz
        self.governor = Governor(robot, self.tick)
        self._controller = CartesianController(1 / spec.control_hz, *WORKSPACE)
        self.restart()

    def restart(self) -> None:
        """Forget everything; the next joint state is where the arm is taken over."""
        self.governor = Governor(self.governor.robot, self.tick)
        self.state, self.reason = State.WAITING, "no joint state yet"
        self.instruction, self._told_at, self._time_is_up = "", 0.0, False
        self.overruns, self.rejections = 0, 0
        self._frames = Frames(self.spec.cameras)
        self._seen_until = -np.inf
        self._measured: deque[tuple[float, Array, Array, float]] = deque()
        self._commanded: deque[tuple[float, Array]] = deque()
        self._schedule: list[tuple[float, Array, float]] = []  # when due, goal, opening
        self._pending: tuple[float, float, Array] | None = None  # asked at, observed at, commanded then
        self._next_look, self._opening = -np.inf, 1.0
        self.observed = -np.inf  # when what was last looked at was seen
        self.resumed = True  # whether the last look was the first since it runs
        self._astray_since: float | None = None

    @property
    def robot(self) -> Robot:
        """The arm and its limits."""
        return self.governor.robot

    # What comes in.

    def see(self, camera: str, image: Array, at: float) -> None:
        """An image (H, W, 3) uint8 that was taken at `at`."""
        self._frames.see(camera, image, at)

    def feel(self, joints: Array, velocities: Array, opening: float, at: float) -> None:
        """Measured joints (J,) [rad], their velocities [rad/s] and the gripper's opening [m], at `at`."""
        self._measured.append((at, joints, velocities, opening))
        while self._measured[0][0] < at - MEMORY:
            self._measured.popleft()

    def listen(self, instruction: str, now: float) -> bool:
        """A new task in words, which ends a stop because the time was up; empty words stop the arm.

        Returns whether the instruction is followed: not after any other stop, nor after a fault.
        """
        if not instruction.strip():
            self.stop("the instruction is empty")
            return False
        self.instruction, self._told_at = instruction.strip(), now
        self._schedule, self._next_look = [], -np.inf
        if self.state is State.STOPPED and self._time_is_up:
            self.resume(now)
        return self.state not in (State.STOPPED, State.FAULT)

    def stop(self, reason: str, way_out: str = RESUME) -> None:
        """Stand still until resumed; `way_out` tells a person how."""
        if self.state is not State.FAULT:
            self._time_is_up = False
            self._enter(State.STOPPED, f"{reason}; to go on: {way_out}")

    def resume(self, now: float) -> bool:
        """Go on after a stop; false where there is nothing to go on with."""
        if self.state is not State.STOPPED:
            return False
        self._told_at = now
        self._enter(State.HOLDING, "resumed, waiting for fresh frames")
        return True

    def fail(self, reason: str) -> None:
        """Stand still until deactivated."""
        self._enter(State.FAULT, f"{reason}; to go on: {RESTART}")

    def hold(self, reason: str) -> None:
        """Stand still until frames are fresh again."""
        if self.state in (State.WAITING, State.RUNNING, State.HOLDING):
            self._enter(State.HOLDING, reason)

    # What the policy is asked.

    def look(self, now: float) -> Observation | None:
        """What to ask the policy about, if it is time to; then `plan` or `reject` must follow."""
        observed = self._frames.taken_at
        if self.state is not State.RUNNING or self._pending is not None or observed is None:
            return None
        if observed <= self._seen_until or observed < self._next_look - EARLY / self.spec.control_hz:
            return None
        if self._schedule and now > self._schedule[-1][0] + 0.5 / self.spec.control_hz:
            self.overruns += 1
        _, joints, velocities, opening = min(self._measured, key=lambda measured: abs(measured[0] - observed))
        # Where the arm was sent at that time: the measured pose lags, and goals would run away from an arm whose limits
        # hold it back, which a policy that sees it lagging would then overshoot.
        anchor = min(self._commanded, key=lambda command: abs(command[0] - observed))[1]
        self.resumed, self._seen_until, self.observed = np.isinf(self._seen_until), observed, observed
        self._pending = (now, observed, anchor)
        return Observation(
            rgb=self._frames.images,
            depth={},
            joints=joints.astype(np.float32),
            velocities=velocities.astype(np.float32),
            gripper=opening,
            instruction=self.instruction,
        )

    def plan(self, actions: Array, now: float) -> None:
        """The policy's answer: actions (k, D), the first of which starts when the observation was made.

        Each moves on from the goal of the one before, the first from what was commanded at the observation; of those
        whose time has passed only the ends are made up for.
        """
        if self._pending is None:
            return
        _, observed, anchor = self._pending
        self._pending = None
        if actions.ndim != 2 or actions.shape[1] != len(ACTION) or not len(actions) or not np.isfinite(actions).all():
            return self._refuse(
                f"the policy answered with {'numbers that are not finite' if actions.ndim == 2 else actions.shape}"
            )
        if self.state is not State.RUNNING:
            return None
        self.rejections = 0
        period = 1 / self.spec.control_hz
        actions = np.clip(actions, self.spec.low, self.spec.high)
        self._controller.reset(anchor)
        goals = [self._controller.step(action[:6]).copy() for action in actions]
        ends = observed + period * np.arange(1, len(actions) + 1)
        self._schedule = list(zip(ends.tolist(), goals, actions[:, 6].tolist(), strict=True))
        self._next_look = float(ends[-1])
        return None

    def reject(self, reason: str) -> None:
        """The policy could not answer."""
        self._pending = None
        self._refuse(reason)

    # What goes out.

    def command(self, now: float) -> Command | None:
        """The command of this tick; None before the first joint state."""
        self._supervise(now)
        if not self._commanded:
            return None
        if self.state is State.RUNNING and self._schedule:
            while len(self._schedule) > 1 and self._schedule[0][0] <= now:
                self._schedule.pop(0)
            end, goal, self._opening = self._schedule[0]
            self.governor.step(goal, end - now)
        else:
            self.governor.brake()
        self._remember(now)
        return Command(self.governor.position.copy(), self.governor.velocity.copy(), self._opening)

    def horizon(self, now: float) -> list[Command]:
        """The commands that would follow this tick's if nothing new were heard; the last one is at rest."""
        governor = copy.copy(self.governor)
        commands = []
        schedule = list(self._schedule) if self.state is State.RUNNING else []
        while schedule and now < schedule[-1][0]:
            now += self.tick
            while len(schedule) > 1 and schedule[0][0] <= now:
                schedule.pop(0)
            governor.step(schedule[0][1], schedule[0][0] - now)
            commands.append(Command(governor.position.copy(), governor.velocity.copy(), schedule[0][2]))
        while not governor.resting or not commands:
            governor.brake()
            commands.append(Command(governor.position.copy(), governor.velocity.copy(), self._opening))
        return commands

    # Why not.

    def _supervise(self, now: float) -> None:
        """Change state where something is missing, late or wrong, or fresh again."""
        if not self._measured:
            return
        measured = self._measured[-1][1]
        if not self._commanded:
            self._take_over(measured, now)
        if self.state in (State.STOPPED, State.FAULT):
            return
        late = self._late(now)
        if self._astray(measured, now):
            return self.fail(f"the arm is more than {self.safety.tracking} rad from where it was sent")
        if not self.instruction:
            return self._enter(State.WAITING, "no instruction yet")
        if self.safety.instruction is not None and now - self._told_at > self.safety.instruction:
            self.stop(f"{self.safety.instruction:g} s on one instruction are over", "say what to do next")
            self._time_is_up = True
            return None
        if late:
            self._frames.fresh = 0
            return self._enter(State.HOLDING if self.state is State.RUNNING else self.state, late)
        recovered = self.state is State.HOLDING and self._frames.fresh >= self.safety.fresh_frames
        if self.state is State.WAITING or recovered:
            self._enter(State.RUNNING, "")
        return None

    def _take_over(self, measured: Array, now: float) -> None:
        try:
            self.governor.start(measured)
        except ValueError as error:
            return self.fail(str(error))
        stroke = max(self.robot.finger_travel * len(self.robot.fingers), 1e-6)
        self._opening = float(np.clip(self._measured[-1][3] / stroke, 0.0, 1.0))
        return self._remember(now)

    def _late(self, now: float) -> str:
        """What is too old to act on, in words."""
        if late := self._frames.late(now, self.safety.image_age):
            return late
        if now - self._measured[-1][0] > self.safety.joints_age:
            return f"the newest joint state is older than {self.safety.joints_age} s"
        if self._pending is not None and now - self._pending[0] > self.safety.inference:
            return f"the policy takes longer than {self.safety.inference} s"
        return ""

    def _astray(self, measured: Array, now: float) -> bool:
        unknown = now - self._measured[-1][0] > self.safety.joints_age
        if unknown or np.abs(self.governor.position - measured).max() <= self.safety.tracking:
            self._astray_since = None
        elif self._astray_since is None:
            self._astray_since = now
        return self._astray_since is not None and now - self._astray_since > self.safety.tracking_for

    def _refuse(self, reason: str) -> None:
        self.rejections += 1
        if self.rejections >= self.safety.rejected:
            self.fail(f"{reason}, {self.rejections} times in a row")
        else:
            self.hold(reason)

    def _enter(self, state: State, reason: str) -> None:
        if state is not self.state and state is not State.RUNNING:
            self._frames.fresh, self._schedule = 0, []
            self._next_look = self._seen_until = -np.inf
        self.state, self.reason = state, reason

    def _remember(self, now: float) -> None:
        self._commanded.append((now + self.tick, self.governor.position.copy()))
        while self._commanded[0][0] < now - MEMORY:
            self._commanded.popleft()
