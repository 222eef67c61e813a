"""Joint commands within the limits of a robot, for any goal: plain numpy, no ROS.

Shapes: J joints. Positions [rad], speeds [rad/s], accelerations [rad/s²].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le, MinLen

from vla.io.errors import UserError
from vla.io.types import NonNegative, Positive, Text, unique
from vla.spec import Array, RobotModel

PositiveShare = Annotated[float, Gt(0), Le(1)]

REST = 1e-9  # lower speeds are rounding errors [rad/s]


@dataclass(frozen=True)
class JointLimits:
    """Names and limits of the joints of an arm and its gripper. Raises a UserError if lists have different lengths, a
    joint is named twice, or the lowest position of a joint, with the margin, is not below the highest.

    Attributes:
        joints: J names, base to tip.
        grippers: those among them that move fingers, which things between these keep away from their commands.
        low, high: position limits [rad].
        speed, acceleration: limits [rad/s], [rad/s²].
        fingers: names of the finger joints.
        finger_open, finger_closed: position of each of them when the gripper is open, and at an opening of 0, between
            which the opening is proportional [m] or [rad].
        widest: opening of the open gripper, in the policy's state [m]; None without fingers.
        margin: distance kept from the position limits [rad].
        overshoot: largest overshoot of the last goal, which lets joints pass goals without stopping [rad].
        speed_share, acceleration_share: usable share of those limits, above 0 and at most 1.
    """

    joints: Annotated[list[Text], MinLen(1)]
    grippers: list[Text]
    low: list[float]
    high: list[float]
    speed: list[Positive]
    acceleration: list[Positive]
    fingers: list[Text]
    finger_open: list[float]
    finger_closed: list[float]
    widest: Positive | None
    margin: NonNegative
    overshoot: NonNegative
    speed_share: PositiveShare
    acceleration_share: PositiveShare

    def __post_init__(self) -> None:
        lengths = {len(values) for values in (self.joints, self.low, self.high, self.speed, self.acceleration)}
        if len(lengths) != 1:
            raise UserError(
                "deploy.robot needs one entry per joint in each of joints, low, high, speed and acceleration"
            )
        if not unique([*self.joints, *self.fingers]):
            raise UserError("deploy.robot names a joint twice among its joints and fingers")
        if unknown := [name for name in self.grippers if name not in self.joints]:
            raise UserError(f"deploy.robot.grippers names {', '.join(unknown)}, which is not among its joints")
        if not len(self.fingers) == len(self.finger_open) == len(self.finger_closed) or (
            self.fingers and (self.widest is None or (self._finger_travel == 0).any())
        ):
            raise UserError(
                "deploy.robot.fingers need, in finger_open and finger_closed, the position of each when the gripper is "
                "open and another when it is closed, and in widest the opening of the open gripper in m"
            )
        if not (self.min_position < self.max_position).all():
            raise UserError("deploy.robot.low must be below high by more than twice the margin, for every joint")

    def require(self, model: RobotModel, owner: str, key: str = "deploy.robot") -> None:
        """Raise a UserError unless an arm of these limits, at `key`, can be that of `owner`, a policy or a task."""
        if len(self.joints) != len(model.joints):
            raise UserError(
                f"{owner} has {len(model.joints)} joints, the robot {len(self.joints)}: choose another option "
                f"of deploy/robot for {key}"
            )
        for name, robot_name in zip(model.joints, self.joints, strict=True):
            if name != robot_name and name in self.joints:
                raise UserError(
                    f"{owner} has {name} where {key}.joints has {robot_name}: list joints and limits of the "
                    f"robot in {owner}'s order, {', '.join(model.joints)}"
                )
        if model.gripper and not self.fingers:
            raise UserError(f"{owner} sees how far its gripper is open: name the joints in {key}.fingers")

    @cached_property
    def is_arm(self) -> Array:
        """(J,) whether a joint moves the arm, not fingers."""
        return np.array([name not in self.grippers for name in self.joints])

    @cached_property
    def min_position(self) -> Array:
        """(J,) smallest allowed positions [rad]."""
        return np.array(self.low) + self.margin

    @cached_property
    def max_position(self) -> Array:
        """(J,) largest allowed positions [rad]."""
        return np.array(self.high) - self.margin

    @cached_property
    def max_speed(self) -> Array:
        """(J,) largest allowed speeds [rad/s]."""
        return np.array(self.speed) * self.speed_share

    @cached_property
    def max_acceleration(self) -> Array:
        """(J,) largest allowed accelerations [rad/s²]."""
        return np.array(self.acceleration) * self.acceleration_share

    @cached_property
    def _finger_travel(self) -> Array:
        return np.subtract(self.finger_open, self.finger_closed)

    def share(self, opening: float) -> float:
        """Return the opening, 0 closed … 1 open, of one in m; 0 without fingers."""
        return opening / self.widest if self.widest else 0.0

    def finger_positions(self, opening: float) -> list[float]:
        """Return the position of every finger joint at an opening, 0 closed … 1 open."""
        return (self.finger_closed + opening * self._finger_travel).tolist()

    def opening(self, fingers: Mapping[str, float]) -> float:
        """Return the opening, 0 closed … 1 open, at positions of one finger joint or more: the mean of theirs."""
        indices = [self.fingers.index(name) for name in fingers]
        travelled = np.array([*fingers.values()]) - np.array(self.finger_closed)[indices]
        return float(np.mean(travelled / self._finger_travel[indices]))


class JointLimiter:
    """Moves a commanded position towards goals within the limits of position, speed and acceleration.

    It integrates its own command, because the measured position lags behind: restarting from that at every goal would
    make the arm oscillate and fall short.
    """

    def __init__(self, limits: JointLimits, period: float) -> None:
        """Args: the limits; time between commands [s]."""
        self.limits, self._period = limits, period
        self.position = np.zeros(len(limits.joints))
        self.velocity = np.zeros(len(limits.joints))

    def start(self, measured: Array) -> None:
        """Start from the measured position (J,), at rest; raise a UserError if the arm is outside its limits. A gripper
        may be, because it closes until something stops it."""
        low, high = self.limits.min_position, self.limits.max_position
        measured = np.where(self.limits.is_arm, measured, np.clip(measured, low, high))
        violations = (measured < low) | (measured > high)
        if violations.any():
            joint = int(np.argmax(violations))
            raise UserError(
                f"{self.limits.joints[joint]} is at {measured[joint]:.3f} rad, outside "
                f"{low[joint]:.3f} to {high[joint]:.3f}: move it inside first"
            )
        self.hold(measured)

    def hold(self, position: Array) -> None:
        """Command a position (J,), at rest, whatever the limits are."""
        self.position, self.velocity = np.array(position, dtype=float), np.zeros(len(position))

    def step(self, goal: Array, remaining: float = 0.0) -> Array:
        """Return the next command (J,) towards `goal` (J,), which is due in `remaining` seconds."""
        distance = np.clip(goal, self.limits.min_position, self.limits.max_position) - self.position
        velocity = distance / max(remaining, self._period)
        limit = np.minimum(self._stopping_speed(np.abs(distance) + self.limits.overshoot), self.limits.max_speed)
        # Scale all joints alike, so that the tool stays on its path.
        speed = np.abs(velocity)
        share = np.min(np.divide(limit, speed, out=np.ones_like(speed), where=speed > limit))
        return self._move(share * velocity)

    def brake(self) -> Array:
        """Return the next command (J,) of the fastest stop."""
        return self._move(np.zeros_like(self.velocity))

    @property
    def resting(self) -> bool:
        """True if the commanded velocity is zero."""
        return not self.velocity.any()

    def _move(self, velocity: Array) -> Array:
        change = self.limits.max_acceleration * self._period
        velocity = np.clip(velocity, -self.limits.max_speed, self.limits.max_speed)
        velocity = np.clip(velocity, self.velocity - change, self.velocity + change)
        # Keep the braking distance within the position limits.
        speed_up = self._stopping_speed(self.limits.max_position - self.position)
        speed_down = self._stopping_speed(self.position - self.limits.min_position)
        velocity = np.clip(velocity, -speed_down, speed_up)
        self.velocity = np.where(np.abs(velocity) < REST, 0.0, velocity)
        self.position = self.position + self.velocity * self._period
        return self.position.copy()

    def _stopping_speed(self, distance: Array) -> Array:
        """(J,) largest speed from which constant deceleration stops within `distance` (J,), this step included."""
        change = self.limits.max_acceleration * self._period
        unit = change * self._period  # distance by which each further step of braking is longer
        steps = np.maximum(distance, 0.0) / unit
        whole_steps = np.floor((np.sqrt(1 + 8 * steps) - 1) / 2)  # n steps cover n(n + 1)/2 of these
        return change * (whole_steps + (steps - whole_steps * (whole_steps + 1) / 2) / (whole_steps + 1))
