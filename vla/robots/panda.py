"""Cartesian control of the Panda: forward kinematics and one differential inverse-kinematics step, in plain numpy.

Shared by the simulator and the robot node, and therefore free of MuJoCo and torch.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from vla.spec import Array

# Denavit-Hartenberg parameters in Craig's convention, Franka Control Interface documentation, "Denavit-Hartenberg":
# a [m], d [m] and alpha [quarter turns] of each joint. Everything else about the kinematics is derived from them.
DENAVIT_HARTENBERG = (
    (0.0, 0.333, 0),
    (0.0, 0.0, -1),
    (0.0, 0.316, 1),
    (0.0825, 0.0, 1),
    (-0.0825, 0.384, -1),
    (0.0, 0.0, 1),
    (0.088, 0.0, 1),
)
FLANGE = 0.107  # joint 7 to flange, where the hand sits [m], ibid.
HAND_YAW = -np.pi / 4  # flange to Franka Hand [rad], franka_description, hand.xacro
HAND_TO_TCP = 0.1034  # hand to the point between the fingertips [m], ibid.

# (8, 7) pose of each joint's frame, and last the tool's, in the frame before: offset [m] and unnormalised quaternion
# wxyz, which is exact for quarter turns.
CHAIN = (
    *((a, 0.0 - d * turn, d * (1 - abs(turn)), 1.0, float(turn), 0.0, 0.0) for a, d, turn in DENAVIT_HARTENBERG),
    (0.0, 0.0, FLANGE + HAND_TO_TCP, math.cos(HAND_YAW / 2), 0.0, 0.0, math.sin(HAND_YAW / 2)),
)

# Joint limits, Franka Control Interface documentation, "Limits for Panda".
JOINT_LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])  # [rad]
JOINT_HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])  # [rad]
JOINT_SPEED = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])  # [rad/s]
LIMIT_MARGIN = 0.05  # distance kept from the joint limits [rad]
LOWEST, HIGHEST = JOINT_LOW + LIMIT_MARGIN, JOINT_HIGH - LIMIT_MARGIN

HOME = np.array([0.0, 0.1, 0.0, -2.1, 0.0, 2.2, 0.785])  # gripper pointing down over the table [rad]
FINGER_TRAVEL = 0.04  # of each finger [m], franka_description, hand.xacro
FINGER_SPEED = 0.2  # of each finger [m/s], ibid.
MAX_OPENING = 2 * FINGER_TRAVEL  # between the fingertips [m]
DOWN = np.diag([1.0, -1.0, -1.0])  # rotation of a gripper that points down

DAMPING = 0.02  # of the least squares: bounds joint speeds near singularities
_DAMPING = DAMPING**2 * np.eye(6)
POSTURE_GAIN = 0.1  # share of the null-space error from the home posture that one iteration removes
ITERATIONS = 6
TOLERANCE = 1e-4  # [m] and [rad]


def _link(a: float, d: float, turn: int) -> Array:
    """Return the constant part of a joint's transform: rotation about x by alpha, then the offsets a and d."""
    cosine, sine = np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)
    return np.array([[1, 0, 0, a], [0, cosine, -sine, -d * sine], [0, sine, cosine, d * cosine], [0, 0, 0, 1.0]])


_LINKS = np.stack([_link(*parameters) for parameters in DENAVIT_HARTENBERG])


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
    # A joint's own rotation changes neither its axis nor its origin.
    (ax, ay, az), (x, y, z) = moved[:, :3, 2].T, pose[:3, 3:] - moved[:, :3, 3].T
    # Linear rows: axis cross lever arm, written out because np.cross would take longer than everything else here.
    return pose, np.array([ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az])


def velocity_of(joints: Array, velocities: Array) -> Array:
    """Return the (6,) velocity of the tool centre point [m/s], [rad/s] in the base frame.

    Args:
        joints: (7,) [rad].
        velocities: of the joints (7,) [rad/s].
    """
    velocity: Array = forward(joints)[1] @ velocities
    return velocity


def solve(target: Array, joints: Array) -> Array:
    """Find joints near `joints` that bring the tool centre point to the (4, 4) pose `target`, by damped least squares.

    Unreachable poses are approached as far as the joint limits allow.
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

    Deltas are relative to the last *commanded* pose: relative to the measured one, which lags, the arm would drift and,
    with latency, oscillate.
    """

    # Names and units of the action components that it takes.
    motion: tuple[tuple[str, str], ...] = (
        ("dx", "m"),
        ("dy", "m"),
        ("dz", "m"),
        ("rx", "rad"),
        ("ry", "rad"),
        ("rz", "rad"),
    )

    def __init__(self, period: float, low: ArrayLike, high: ArrayLike) -> None:
        """Args: control period [s]; corners (3,) of the box for the tool point in the base frame [m]."""
        self.period, self.low, self.high = period, np.asarray(low), np.asarray(high)
        self.joints = HOME.copy()  # (7,) last commanded [rad]
        self.pose = forward(self.joints)[0]  # (4, 4) last commanded

    def reset(self, joints: Array) -> None:
        """Set the last commanded joints (7,) [rad], for example to the measured ones."""
        self.joints = np.array(joints, dtype=float)
        self.pose = forward(self.joints)[0]

    def step(self, motion: Array) -> Array:
        """Return joint targets (7,) [rad] one period ahead, within position and speed limits.

        Args:
            motion: (6,) translation [m] and rotation vector [rad] in the base frame.
        """
        target = np.eye(4)
        target[:3, 3] = np.clip(self.pose[:3, 3] + motion[:3], self.low, self.high)
        target[:3, :3] = rotation_from_vector(motion[3:6]) @ self.pose[:3, :3]
        reach = JOINT_SPEED * self.period
        solution = solve(target, self.joints)
        self.joints = self.joints + np.clip(solution - self.joints, -reach, reach)
        self.pose = forward(self.joints)[0]
        return self.joints

    def motion_between(self, before: Array, after: Array) -> Array:
        """Return the (6,) translation [m] and rotation vector [rad] of the tool between joints (7,) [rad]."""
        start, end = forward(before)[0], forward(after)[0]
        turn = vector_from_rotation(end[:3, :3] @ start[:3, :3].T)
        return np.concatenate([end[:3, 3] - start[:3, 3], turn])
