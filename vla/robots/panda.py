"""Kinematics of the Panda in plain numpy, and its limits."""

from __future__ import annotations

import math

import numpy as np

from vla.robots.cartesian import LIMIT_MARGIN, Kinematics, rotation_z
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
LOWEST, HIGHEST = JOINT_LOW + LIMIT_MARGIN, JOINT_HIGH - LIMIT_MARGIN

HOME = np.array([0.0, 0.1, 0.0, -2.1, 0.0, 2.2, 0.785])  # gripper pointing down over the table [rad]
FINGER_TRAVEL = 0.04  # of each finger [m], franka_description, hand.xacro
FINGER_SPEED = 0.2  # of each finger [m/s], ibid.
MAX_OPENING = 2 * FINGER_TRAVEL  # between the fingertips [m]


def _link(a: float, d: float, turn: int) -> Array:
    """Return the constant part of a joint's transform: rotation about x by alpha, then the offsets a and d."""
    cosine, sine = np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)
    return np.array([[1, 0, 0, a], [0, cosine, -sine, -d * sine], [0, sine, cosine, d * cosine], [0, 0, 0, 1.0]])


_LINKS = np.stack([_link(*parameters) for parameters in DENAVIT_HARTENBERG])
_TOOL = np.eye(4)
_TOOL[:3, :3] = rotation_z(HAND_YAW)
_TOOL[2, 3] = FLANGE + HAND_TO_TCP


def forward(joints: Array) -> tuple[Array, Array]:
    """Pose of the tool centre point in the base frame, and its Jacobian.

    Returns:
        (4, 4) homogeneous pose [m] and (6, 7) Jacobian, linear rows [m/rad] before angular rows.
    """
    cosine, sine = np.cos(joints)[:, None], np.sin(joints)[:, None]
    frames = _LINKS.copy()
    x, y = _LINKS[:, :, 0], _LINKS[:, :, 1]
    frames[:, :, 0], frames[:, :, 1] = cosine * x + sine * y, cosine * y - sine * x
    for index in range(1, 7):
        frames[index] = frames[index - 1].dot(frames[index])  # half the time of np.matmul for such small matrices
    pose = frames[6] @ _TOOL
    # A joint's own rotation changes neither its axis nor its origin.
    (ax, ay, az), (x, y, z) = frames[:, :3, 2].T, pose[:3, 3:] - frames[:, :3, 3].T
    # Linear rows: axis cross lever arm, written out because np.cross would take longer than everything else here.
    return pose, np.array([ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az])


PANDA = Kinematics(forward, HOME, LOWEST, HIGHEST, JOINT_SPEED)
