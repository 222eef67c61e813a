"""Observations out of images and joint states that arrive one by one, for a policy and for the import of bags. No ROS.

All times are seconds on one clock. Shapes: J joints, P state components.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vla.deploy.camera_sync import CameraSync
from vla.io.errors import UserError
from vla.robots.controllers import UNITS
from vla.spec import Array, Observation, Spec

EARLY_SHARE = 0.25  # share of a control period by which an image may precede the next planned observation
HISTORY = 1.0  # duration of the history of joint states [s]
OLDEST = 10.0  # age from which on a time stamp is taken for one of another clock [s]


class Measured(NamedTuple):
    """A joint state."""

    at: float
    joints: Array  # (J,) [rad]
    velocities: Array  # (J,) [rad/s]
    opening: float  # of the gripper [m]


class Observer:
    """The newest matching images, with the joint state nearest to them in time."""

    def __init__(self, spec: Spec) -> None:
        """Args: the spec of the policy.

        Raises:
            UserError: the spec has no robot, or its state has more than joint states contain.
        """
        self._spec, self._model = spec, spec.require_robot("deployment")
        if others := [name for name in spec.state if name not in self._model.components]:
            raise UserError(f"the policy's state has {', '.join(others)}, which joint states do not contain")
        self._factors = np.array([UNITS.get(unit.removesuffix("/s"), 1.0) for unit in spec.state_units])
        self.cameras = CameraSync(spec.cameras)
        self._measured: deque[Measured] = deque()

    def on_joint_state(self, measured: Measured) -> None:
        """Add a joint state."""
        self._measured.append(measured)
        while self._measured[0].at < measured.at - HISTORY:
            self._measured.popleft()

    @property
    def newest(self) -> Measured | None:
        """The newest joint state."""
        return self._measured[-1] if self._measured else None

    def moved(self, seconds: float) -> float:
        """Return how far a joint has moved within the last `seconds` of the history [rad]."""
        recent = [each.joints for each in self._measured if each.at >= self._measured[-1].at - seconds]
        return float(np.ptp(recent, axis=0).max()) if recent else 0.0

    def due(self, after: float, earliest: float) -> float | None:
        """Return when the newest images were taken, if they match, later than `after` and about from `earliest` on."""
        taken = self.cameras.taken_at
        early = EARLY_SHARE / self._spec.control_hz
        return None if taken is None or taken <= after or taken < earliest - early else taken

    def measured_at(self, at: float) -> Measured:
        """Return the joint state nearest to `at` in the history."""
        return min(self._measured, key=lambda measured: abs(measured.at - at))

    def observation(self, at: float, instruction: str) -> Observation:
        """Return the newest images, taken at `at`, with the joint state of that time."""
        return Observation(self.cameras.images, self.state(self.measured_at(at)), instruction)

    def state(self, measured: Measured) -> Array:
        """Return the robot state (P,) float32 in the order and units of the spec."""
        model = self._model
        values = dict(zip(model.joints, measured.joints, strict=True))
        values |= dict(zip(model.velocities, measured.velocities, strict=False))
        return np.array([values.get(name, measured.opening) for name in self._spec.state] / self._factors, np.float32)


def age_of(stamp: tuple[int, int], now: float) -> float:
    """Return the age [s] of a message by its time stamp; 0 if the stamp cannot come from the clock of `now` [s]."""
    age = now - (stamp[0] + stamp[1] * 1e-9)
    return age if stamp != (0, 0) and 0 <= age < OLDEST else 0.0
