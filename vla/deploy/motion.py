"""From the actions of a policy to goals of the joints, and to commands within the limits of the arm. No ROS.

All times are seconds on one monotonic clock. Shapes: J joints, k actions of a plan, D action components.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vla.deploy.joint_limiter import JointLimiter, JointLimits
from vla.deploy.observer import HISTORY
from vla.io.errors import UserError
from vla.io.types import Point
from vla.robots.cartesian import CartesianController
from vla.robots.controllers import controller_for, gripper_index
from vla.schedule import Schedule
from vla.spec import Array, Spec

Waypoint = tuple[float, Array, float | None]  # when due, goal of the joints (J,) [rad], opening


LEEWAY = 0.005  # by which the tool may leave the workspace [m]: joints do not move it along a straight line


@dataclass(frozen=True)
class Command:
    """Joint targets for the end of a tick."""

    position: Array  # (J,) [rad]
    velocity: Array  # (J,) [rad/s]
    opening: float | None  # of the gripper, 0 closed … 1 open; None leaves it as it is


@dataclass(frozen=True, eq=False)
class _Workspace:
    """Box that the tool point does not leave, whatever the joints do on their way between two goals."""

    forward: Callable[[Array], tuple[Array, Array]]  # as in `Kinematics`
    low: Array  # corners (3,) in the frame of Cartesian actions [m]
    high: Array

    def step(self, limiter: JointLimiter, goal: Array, remaining: float) -> None:
        """Step `limiter` towards a goal, see `JointLimiter.step`, or brake if it could not stop inside after that step.

        A tool that is outside may come back, but not move further away.
        """
        trial = copy.copy(limiter)
        trial.step(goal, remaining)
        position, velocity = trial.position, trial.velocity
        while (distance := self._outside(trial.position)) <= LEEWAY or distance <= self._outside(limiter.position):
            if trial.resting:
                limiter.position, limiter.velocity = position, velocity
                return
            trial.brake()
        limiter.brake()

    def _outside(self, joints: Array) -> float:
        """Return the distance [m] along an axis by which the tool is outside of the box; 0 or less inside."""
        tool = self.forward(joints)[0][:3, 3]
        return float(np.max([self.low - tool, tool - self.high]))


class Goals:
    """Turns the actions of a policy into joint goals, one per control period."""

    def __init__(self, spec: Spec, limits: JointLimits, box: tuple[Point, Point] | None) -> None:
        """Args: of the policy; of the arm; corners of the box for the tool point of Cartesian actions.

        Raises:
            UserError: the arm cannot execute such actions, or cannot be kept in the box.
        """
        limits.require(spec.require_robot("deployment"), "the policy")
        self._spec, self._gripper = spec, gripper_index(spec)
        self.has_gripper = self._gripper is not None
        reach = limits.min_position, limits.max_position, np.array(limits.speed)
        self._controller = controller = controller_for(spec, box, reach)
        self.workspace = None
        if isinstance(controller, CartesianController):
            self.workspace = _Workspace(controller.arm.forward, controller.low, controller.high)

    def waypoints(self, actions: Array, observation_time: float, anchor: Array) -> list[Waypoint]:
        """Return the goals of actions (k, D); the first one begins at the time of the observation.

        Cartesian actions are relative to the last goal, the first to the joints `anchor` (J,); joint positions are not.
        Raises a UserError if the actions have another shape or are not finite.
        """
        if actions.ndim != 2 or not len(actions) or actions.shape[1] != len(self._spec.action):
            raise UserError(f"the policy returned actions of the shape {actions.shape}")
        if not np.isfinite(actions).all():
            raise UserError("the policy returned numbers that are not finite")
        actions = np.clip(actions, self._spec.low, self._spec.high)
        ends = observation_time + np.arange(1, len(actions) + 1) / self._spec.control_hz
        openings = [None] * len(actions)
        if self._gripper is not None:  # bounds that follow from data may be beyond 0 and 1
            openings = np.clip(actions[:, self._gripper], 0, 1).tolist()
            actions = np.delete(actions, self._gripper, axis=1)
        self._controller.reset(anchor)
        goals = [self._controller.step(action).copy() for action in actions]
        return list(zip(ends.tolist(), goals, openings, strict=True))


class Motion:
    """The commanded state of an arm: it moves along a schedule, and brakes without one."""

    def __init__(self, limits: JointLimits, tick: float, period: float, workspace: _Workspace | None) -> None:
        """Args: joint limits; time between commands [s]; duration of an action [s]; box of the tool point, if any."""
        self.limiter, self.tick = JointLimiter(limits, tick), tick
        self._workspace, self._period = workspace, period
        self.schedule = Schedule[Waypoint](period)
        self._opening: float | None = None
        self._commanded: deque[tuple[float, Array]] = deque()  # at, joints
        # Trajectory that an arm executes by itself: since when, the state before it and its commands, and whether it is
        # still to be followed.
        self._sent_trajectory: tuple[float, list[Command]] | None = None
        self._sent_valid = False

    @property
    def started(self) -> bool:
        """Whether there is a commanded pose."""
        return bool(self._commanded)

    def start(self, measured: Array, now: float) -> None:
        """Take an arm over at its measured joints (J,), at rest; raise a UserError if it is outside its limits."""
        self.limiter.start(measured)
        self._opening = None  # a grip would loosen at its measured opening
        self._sent_trajectory, self._sent_valid = None, False
        self._commanded.clear()
        self._record(now)

    def hold(self, measured: Array) -> None:
        """Command the measured joints (J,), so that an arm that is elsewhere is not pulled back, but not those of a
        gripper, because a grip would loosen."""
        self.limiter.hold(np.where(self.limiter.limits.is_arm, measured, self.limiter.position))
        self._sent_trajectory, self._sent_valid = None, False

    def follow(self, plan: list[Waypoint], position: Array | None = None) -> None:
        """Replace the plan; its first goal is approached from the commanded position, or from `position` (J,)."""
        if position is not None:
            self.limiter.position, self._sent_trajectory = np.array(position, float), None
        self.schedule, self._sent_valid = Schedule[Waypoint](self._period), False
        if plan:
            self.schedule.add(plan, plan[0][0] - self._period)

    def commanded_joints(self, time: float) -> Array:
        """Return the joints (J,) that were commanded nearest to a time."""
        return min(self._commanded, key=lambda command: abs(command[0] - time))[1]

    def advance(self, now: float) -> Command:
        """Return the command of this tick."""
        if self._sent_trajectory is not None:
            self._recall(*self._sent_trajectory, now)
        if not self._sent_valid:
            self._last_command = _command(self.limiter, self._opening)
            self._opening = self._step(self.limiter, now, self._opening)
        self._record(now)
        return _command(self.limiter, self._opening)

    def commit(self, command: Command, now: float) -> list[Command] | None:
        """Return the trajectory from this command to rest, for an arm that executes it by itself.

        None if the trajectory that was sent last is still valid.
        """
        if self._sent_valid:
            return None
        trajectory = self.trajectory_to_rest(command, now)
        self._sent_valid = True
        return trajectory

    def trajectory_to_rest(self, command: Command, now: float, max_time: float = math.inf) -> list[Command]:
        """Return the trajectory from this command to rest, which the arm follows until it is sent another one.

        The next command continues from where the arm is on it by then, even if that tick is late.

        Args:
            command: of this tick.
            now: the time of this tick [s].
            max_time: time [s] after which the arm brakes, if the schedule has not ended before.
        """
        limiter, opening = copy.copy(self.limiter), self._opening
        trajectory, time, end = [command], now, min(now + max_time, self.schedule.end)
        while time < end:
            time += self.tick
            opening = self._step(limiter, time, opening)
            trajectory.append(_command(limiter, opening))
        while not limiter.resting or len(trajectory) == 1:
            limiter.brake()
            trajectory.append(_command(limiter, opening))
        self._sent_trajectory = now, [self._last_command, *trajectory]
        return trajectory

    def _recall(self, since: float, trajectory: list[Command], now: float) -> None:
        """Set the commanded state from the `trajectory` sent at `since`: the arm follows that anyway.

        It is the state of this tick while the trajectory is valid, else of the previous one, because a step follows.
        """
        ticks = min(max(round((now - since) / self.tick, 6) + self._sent_valid, 0.0), len(trajectory) - 1.0)
        start, end, share = trajectory[math.floor(ticks)], trajectory[math.ceil(ticks)], ticks % 1
        self.limiter.position = start.position + share * (end.position - start.position)
        self.limiter.velocity = end.velocity.copy()  # with which a command is approached
        self._opening = start.opening

    def _step(self, limiter: JointLimiter, now: float, opening: float | None) -> float | None:
        """Move towards the next goal within limits and workspace, or brake; returns the opening to command."""
        plan = self.schedule.newest_plan
        if plan is None:
            limiter.brake()
            return opening
        # Goals that are already due are skipped, but the last one is held until the next plan.
        end, goal, opening = (self.schedule.actions_at(now) or [plan.actions[-1]])[-1]
        if self._workspace is None:
            limiter.step(goal, end - now)
        else:
            self._workspace.step(limiter, goal, end - now)
        return opening

    def _record(self, now: float) -> None:
        self._commanded.append((now + self.tick, self.limiter.position.copy()))
        while self._commanded[0][0] < now - HISTORY:
            self._commanded.popleft()


def _command(limiter: JointLimiter, opening: float | None) -> Command:
    return Command(limiter.position.copy(), limiter.velocity.copy(), opening)
