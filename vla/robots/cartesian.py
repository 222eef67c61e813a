"""Cartesian control of an arm: inverse kinematics by damped least squares and a controller, in plain numpy.

Shared by the simulator and the robot node, and therefore free of MuJoCo and torch. Shapes: J joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vla.spec import Array

DOWN = np.diag([1.0, -1.0, -1.0])  # rotation of a gripper that points down
LIMIT_MARGIN = 0.05  # distance kept from the joint limits [rad]

DAMPING = 0.02  # of the least squares: bounds joint speeds near singularities
_DAMPING = DAMPING**2 * np.eye(6)
POSTURE_GAIN = 0.1  # share of the null-space error from the home posture that one iteration removes
ITERATIONS = 6
TOLERANCE = 1e-4  # [m] and [rad]


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Model of an arm for inverse kinematics."""

    # Joints (J,) → pose (4, 4) of the tool [m], and Jacobian (6, J), linear [m/rad] above angular, in the frame of the
    # actions: the base's, or that of a world in which the base may stand elsewhere.
    forward: Callable[[Array], tuple[Array, Array]]
    home: Array  # (J,) with the gripper pointing down over the table [rad]
    lowest: Array  # (J,) smallest positions [rad]
    highest: Array  # (J,) largest positions [rad]
    speed: Array  # (J,) largest speeds [rad/s]


def rotation_z(angle: float) -> Array:
    """(3, 3) rotation by `angle` [rad] about z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_vector(vector: ArrayLike) -> Array:
    """(3, 3) rotation by |vector| [rad] about the axis of `vector` (Rodrigues' formula)."""
    x, y, z = np.asarray(vector, dtype=float)
    angle = float(np.sqrt(x * x + y * y + z * z))
    if angle < 1e-12:
        return np.eye(3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]]) / angle
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def vector_from_rotation(rotation: Array) -> Array:
    """(3,) rotation vector [rad] of a (3, 3) rotation whose angle is below pi."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    x, y, z = zy - yz, xz - zx, yx - xy
    sine = math.sqrt(x * x + y * y + z * z) / 2
    if sine < 1e-12:
        return np.zeros(3)
    scale = math.atan2(sine, (xx + yy + zz - 1) / 2) / (2 * sine)
    return np.array([x * scale, y * scale, z * scale])


def solve(arm: Kinematics, target: Array, joints: Array, start: tuple[Array, Array] | None = None) -> Array:
    """Find joints near `joints` (J,) that bring the tool centre point to the (4, 4) pose `target`.

    By damped least squares (Nakamura and Hanafusa, "Inverse kinematic solutions with singularity robustness for robot
    manipulator control", 1986), pulled to the home posture in null space. Unreachable poses are approached as far as
    the joint limits allow. `start` is the result of `arm.forward(joints)`, where it is known.
    """
    joints = joints.copy()
    for iteration in range(ITERATIONS):
        pose, jacobian = start if start and not iteration else arm.forward(joints)
        error = np.concatenate([target[:3, 3] - pose[:3, 3], vector_from_rotation(target[:3, :3] @ pose[:3, :3].T)])
        if all(abs(component) < TOLERANCE for component in error.tolist()):
            break
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + _DAMPING)
        posture = POSTURE_GAIN * (arm.home - joints)
        joints += inverse @ error + posture - inverse @ (jacobian @ posture)
        joints = np.minimum(np.maximum(joints, arm.lowest), arm.highest)
    return joints


class CartesianController:
    """Turns Cartesian deltas into joint targets.

    Deltas are relative to the last *commanded* pose: the measured one lags, so that the arm would drift and oscillate.
    """

    # Names and units of the action components that it takes.
    motion = (("dx", "m"), ("dy", "m"), ("dz", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))

    def __init__(self, arm: Kinematics, period: float, low: ArrayLike, high: ArrayLike) -> None:
        """Take the arm, its control period [s] and corners (3,) of the box for the tool point [m]."""
        self.arm, self.period, self.low, self.high = arm, period, np.asarray(low), np.asarray(high)
        self.reset(arm.home)

    def reset(self, joints: Array) -> None:
        """Set the last commanded joints (J,) [rad], for example to the measured ones."""
        self._command(np.array(joints, dtype=float))

    def _command(self, joints: Array) -> None:
        self.joints = joints  # (J,) last commanded [rad]
        self.pose, self._jacobian = self.arm.forward(joints)  # (4, 4) and (6, J) there

    def step(self, motion: Array) -> Array:
        """Return joint targets (J,) [rad] one period ahead, within position and speed limits.

        Args:
            motion: (6,) translation [m] and rotation vector [rad], in the frame of the arm's kinematics.
        """
        target = np.eye(4)
        target[:3, 3] = np.clip(self.pose[:3, 3] + motion[:3], self.low, self.high)
        target[:3, :3] = rotation_from_vector(motion[3:6]) @ self.pose[:3, :3]
        reach = self.arm.speed * self.period
        solution = solve(self.arm, target, self.joints, (self.pose, self._jacobian))
        self._command(self.joints + np.minimum(np.maximum(solution - self.joints, -reach), reach))
        return self.joints

    def motion_between(self, joints_before: Array, joints_after: Array) -> Array:
        """Return the (6,) translation [m] and rotation vector [rad] of the tool between joints (J,) [rad]."""
        start, end = self.arm.forward(joints_before)[0], self.arm.forward(joints_after)[0]
        turn = vector_from_rotation(end[:3, :3] @ start[:3, :3].T)
        return np.concatenate([end[:3, 3] - start[:3, 3], turn])
