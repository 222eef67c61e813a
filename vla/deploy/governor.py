"""Joint commands that keep to a robot's limits, whatever is asked for: plain numpy, no ROS.

Shapes: J joints. Positions [rad], speeds [rad/s], accelerations [rad/s²].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le, MinLen

from vla.spec import Array
from vla.types import NonNegative, Positive, Text

PositiveShare = Annotated[float, Gt(0), Le(1)]

REST = 1e-9  # slower is rounding [rad/s]


@dataclass(frozen=True)
class Robot:
    """What an arm is called and what it can do.

    Attributes:
        joints: J names, base to tip.
        low, high: position limits [rad].
        speed, acceleration: limits [rad/s], [rad/s²].
        fingers: names of the finger joints.
        finger_travel: position of a finger joint when open; 0 is closed [m].
        margin: kept from the position limits [rad].
        overshoot: how far a joint may run past a goal if no other one follows, so as not to stop at each [rad].
        speed_share, acceleration_share: how much of those limits may be used, above 0 and at most 1.

    Raises:
        ValueError: lists of different lengths, or a share that is none.
    """

    joints: Annotated[list[Text], MinLen(1)]
    low: list[float]
    high: list[float]
    speed: list[Positive]
    acceleration: list[Positive]
    fingers: list[Text]
    finger_travel: Positive = 0.04
    margin: NonNegative = 0.05
    overshoot: NonNegative = 0.01
    speed_share: PositiveShare = 0.25
    acceleration_share: PositiveShare = 0.25

    def __post_init__(self) -> None:
        lengths = {len(values) for values in (self.joints, self.low, self.high, self.speed, self.acceleration)}
        if len(lengths) != 1:
            raise ValueError("deploy.robot needs one entry per joint in joints, low, high, speed and acceleration each")
        if not (0 < self.speed_share <= 1 and 0 < self.acceleration_share <= 1):
            raise ValueError("deploy.robot.speed_share and acceleration_share are above 0 and at most 1")

    @property
    def lowest(self) -> Array:
        """(J,) lowest positions to go to [rad]."""
        return np.array(self.low) + self.margin

    @property
    def highest(self) -> Array:
        """(J,) highest positions to go to [rad]."""
        return np.array(self.high) - self.margin

    @property
    def fastest(self) -> Array:
        """(J,) speeds to keep to [rad/s]."""
        return np.array(self.speed) * self.speed_share

    @property
    def hardest(self) -> Array:
        """(J,) accelerations to keep to [rad/s²]."""
        return np.array(self.acceleration) * self.acceleration_share


class Governor:
    """Moves a commanded position towards goals, never beyond a limit of position, speed or acceleration.

    It integrates its own command: what the arm measures lags behind, and starting over from it would make the arm
    swing (and lose ground) at every goal.
    """

    def __init__(self, robot: Robot, period: float) -> None:
        """Args: the robot; time between commands [s]."""
        self.robot, self._period = robot, period
        self.position = np.zeros(len(robot.joints))
        self.velocity = np.zeros(len(robot.joints))

    def start(self, measured: Array) -> None:
        """Take over at the measured position (J,), at rest.

        Raises:
            ValueError: the arm stands outside its limits.
        """
        out = (measured < self.robot.lowest) | (measured > self.robot.highest)
        if out.any():
            joint = int(np.argmax(out))
            raise ValueError(
                f"{self.robot.joints[joint]} stands at {measured[joint]:.3f} rad, outside "
                f"{self.robot.lowest[joint]:.3f} to {self.robot.highest[joint]:.3f}: move it inside first"
            )
        self.position, self.velocity = np.array(measured, dtype=float), np.zeros(len(measured))

    def step(self, goal: Array, remaining: float = 0.0) -> Array:
        """The next command (J,), on the way to `goal` (J,), which is due in `remaining` seconds."""
        way = np.clip(goal, self.robot.lowest, self.robot.highest) - self.position
        wanted = way / max(remaining, self._period)
        fastest = np.minimum(self._stoppable(np.abs(way) + self.robot.overshoot), self.robot.fastest)
        # All joints slow down alike, so that the tool keeps to its path.
        share = np.min(fastest / np.maximum(np.abs(wanted), fastest))
        return self._move(share * wanted)

    def brake(self) -> Array:
        """The next command (J,) on the shortest way to rest."""
        return self._move(np.zeros_like(self.velocity))

    @property
    def resting(self) -> bool:
        """Whether the command stands still."""
        return not self.velocity.any()

    def _move(self, velocity: Array) -> Array:
        change = self.robot.hardest * self._period
        velocity = np.clip(velocity, -self.robot.fastest, self.robot.fastest)
        # Second, because the speed limit may have been lowered on the way: that is no reason to jerk.
        velocity = np.clip(velocity, self.velocity - change, self.velocity + change)
        # Never so fast towards a position limit that braking would end behind it.
        up = self._stoppable(self.robot.highest - self.position)
        down = self._stoppable(self.position - self.robot.lowest)
        velocity = np.clip(velocity, -down, up)
        self.velocity = np.where(np.abs(velocity) < REST, 0.0, velocity)
        self.position = self.position + self.velocity * self._period
        return self.position.copy()

    def _stoppable(self, distance: Array) -> Array:
        """(J,) largest speed from which steps that brake evenly end within `distance` (J,), this step included."""
        change = self.robot.hardest * self._period
        steps = np.maximum(distance, 0.0) / (change * self._period)  # in units of what one step of braking makes up
        whole = np.floor((np.sqrt(1 + 8 * steps) - 1) / 2)  # n(n + 1)/2 of these are covered in n steps
        return change * (whole + (steps - whole * (whole + 1) / 2) / (whole + 1))
