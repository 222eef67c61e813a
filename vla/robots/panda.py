"""Kinematics of the Panda in plain numpy, and its limits."""

from __future__ import annotations

import math

import numpy as np

from vla.robots.cartesian import LIMIT_MARGIN, Kinematics, rotation_z
from vla.robots.chain import forward_through
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

HOME = np.array([0.0, 0.1, 0.0, -2.1, 0.0, 2.2, 0.785])  # gripper pointing down over the table [rad]
FINGER_TRAVEL = 0.04  # of each finger [m], franka_description, hand.xacro
FINGER_SPEED = 0.2  # of each finger [m/s], ibid.
MAX_OPENING = 2 * FINGER_TRAVEL  # between the fingertips [m]


def _link(a: float, d: float, turn: int) -> Array:
    """Return the constant part of a joint's transform: rotation about x by alpha, then the offsets a and d."""
    cosine, sine = np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)
    return np.array([[1, 0, 0, a], [0, cosine, -sine, -d * sine], [0, sine, cosine, d * cosine], [0, 0, 0, 1.0]])


_TOOL = np.eye(4)
_TOOL[:3, :3] = rotation_z(HAND_YAW)
_TOOL[2, 3] = FLANGE + HAND_TO_TCP

# Joints (7,) → pose (4, 4) of the tool centre point in the base frame, and its Jacobian (6, 7), see `Kinematics`.
forward = forward_through(np.stack([*(_link(*parameters) for parameters in DENAVIT_HARTENBERG), _TOOL]))
PANDA = Kinematics(forward, HOME, JOINT_LOW + LIMIT_MARGIN, JOINT_HIGH - LIMIT_MARGIN, JOINT_SPEED)
