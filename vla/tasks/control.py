"""Cartesian control of the Panda: forward kinematics and one differential inverse-kinematics step, in plain numpy.

The simulator and a robot node share this file, so it needs neither MuJoCo nor torch.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from vla.spec import Array

# Denavit-Hartenberg parameters in Craig's convention, Franka Control Interface documentation, "Denavit-Hartenberg".
DH_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)  # [m]
DH_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)  # [m]
DH_ALPHA = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)  # [rad]
FLANGE = 0.107  # joint 7 to flange [m], ibid.
HAND_YAW = -np.pi / 4  # flange to Franka Hand [rad], franka_description, hand.xacro
HAND_TO_TCP = 0.1034  # hand to the point between the fingertips [m], ibid.

# Joint limits, Franka Control Interface documentation, "Limits for Panda".
JOINT_LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])  # [rad]
JOINT_HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])  # [rad]
JOINT_SPEED = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])  # [rad/s]
LIMIT_MARGIN = 0.05  # kept from the joint limits [rad]
LOWEST, HIGHEST = JOINT_LOW + LIMIT_MARGIN, JOINT_HIGH - LIMIT_MARGIN

HOME = np.array([0.0, 0.1, 0.0, -2.1, 0.0, 2.2, 0.785])  # gripper pointing down over the table [rad]
MAX_OPENING = 0.08  # between the fingertips [m], Franka Hand product manual
DOWN = np.diag([1.0, -1.0, -1.0])  # rotation of a gripper that points straight down

WORKSPACE = ((0.25, -0.40, 0.008), (0.75, 0.40, 0.50))  # corners of the box that the tool point stays in [m]

DAMPING = 0.02  # of the least squares: bounds joint speed near singular poses
_DAMPING = DAMPING**2 * np.eye(6)
POSTURE_GAIN = 0.1  # how fast the elbow drifts to the home posture in the null space
ITERATIONS = 6
TOLERANCE = 1e-4  # [m] and [rad]


def _link(index: int) -> Array:
    """The constant part of joint `index`'s transform: rotation about x by alpha, then the offsets a and d."""
    cosine, sine = np.cos(DH_ALPHA[index]), np.sin(DH_ALPHA[index])
    a, d = DH_A[index], DH_D[index]
    return np.array([[1, 0, 0, a], [0, cosine, -sine, -d * sine], [0, sine, cosine, d * cosine], [0, 0, 0, 1.0]])


_LINKS = np.stack([_link(index) for index in range(7)])


def rotation_z(angle: float) -> Array:
    """(3, 3) rotation by `angle` [rad] about z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


_TOOL = np.eye(4)
_TOOL[:3, :3] = rotation_z(HAND_YAW)
_TOOL[2, 3] = FLANGE + HAND_TO_TCP


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


def forward(joints: Array) -> tuple[Array, Array]:
    """Pose of the tool centre point in the base frame, and its Jacobian.

    Returns:
        (4, 4) homogeneous pose [m] and (6, 7) Jacobian, linear rows [m/rad] before angular rows.
    """
    cosine, sine = np.cos(joints)[:, None], np.sin(joints)[:, None]
    moved = _LINKS.copy()
    x, y = _LINKS[:, :, 0], _LINKS[:, :, 1]
    moved[:, :, 0], moved[:, :, 1] = cosine * x + sine * y, cosine * y - sine * x
    for index in range(1, 7):
        np.matmul(moved[index - 1], moved[index], out=moved[index])
    pose = moved[6] @ _TOOL
    # Turning about its own axis moves neither a joint's axis nor its origin.
    (ax, ay, az), (x, y, z) = moved[:, :3, 2].T, pose[:3, 3:] - moved[:, :3, 3].T
    # The linear rows are the axis crossed with the lever, written out: numpy's cross takes longer than all the rest.
    return pose, np.array([ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az])


def solve(target: Array, joints: Array) -> Array:
    """Joints near `joints` that bring the tool centre point to the (4, 4) pose `target`, by damped least squares.

    What cannot be reached is approached as far as the joint limits allow.
    """
    joints = joints.copy()
    for _ in range(ITERATIONS):
        pose, jacobian = forward(joints)
        error = np.concatenate([target[:3, 3] - pose[:3, 3], vector_from_rotation(target[:3, :3] @ pose[:3, :3].T)])
        if np.abs(error).max() < TOLERANCE:
            break
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + _DAMPING)
        posture = POSTURE_GAIN * (HOME - joints)
        joints += inverse @ error + posture - inverse @ (jacobian @ posture)
        joints = np.minimum(np.maximum(joints, LOWEST), HIGHEST)
    return joints


class CartesianController:
    """Turns Cartesian deltas into joint targets.

    Deltas are anchored on the last *commanded* pose: anchoring on the measured one, which lags, would let the arm
    drift and, with latency, oscillate.
    """

    def __init__(self, period: float, low: ArrayLike, high: ArrayLike) -> None:
        """Args: control period [s]; corners (3,) of the box in the base frame that the tool point must not leave."""
        self.period, self.low, self.high = period, np.asarray(low), np.asarray(high)
        self.joints = HOME.copy()  # (7,) last commanded [rad]
        self.pose = forward(self.joints)[0]  # (4, 4) last commanded

    def reset(self, joints: Array) -> None:
        """Take the measured `joints` (7,) [rad] as what was last commanded."""
        self.joints = np.array(joints, dtype=float)
        self.pose = forward(self.joints)[0]

    def step(self, delta: Array) -> Array:
        """Joint targets (7,) [rad] one period ahead, within position and speed limits.

        Args:
            delta: (6,) translation [m] and rotation vector [rad] in the base frame.
        """
        target = np.eye(4)
        target[:3, 3] = np.clip(self.pose[:3, 3] + delta[:3], self.low, self.high)
        target[:3, :3] = rotation_from_vector(delta[3:6]) @ self.pose[:3, :3]
        reach = JOINT_SPEED * self.period
        solution = solve(target, self.joints)
        self.joints = self.joints + np.clip(solution - self.joints, -reach, reach)
        self.pose = forward(self.joints)[0]
        return self.joints
