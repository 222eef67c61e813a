"""An arm of seven joints and an action that moves it forward."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.deploy.joint_limiter import JointLimits
from vla.deploy.safety import Safety
from vla.robots.panda import CHAIN, HOME, JOINT_HIGH, JOINT_LOW
from vla.spec import RobotModel, Spec

JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))

ARM = RobotModel(
    JOINTS, "panda_link0", tuple(f"{joint}_velocity" for joint in JOINTS), "gripper", CHAIN, tuple(HOME.tolist())
)
SPEC = Spec(
    cameras=("front", "wrist"),
    image_size=(8, 8),
    state=ARM.components,
    state_units=("rad",) * 7 + ("rad/s",) * 7 + ("m",),
    action=("dx", "dy", "dz", "rx", "ry", "rz", "gripper"),
    units=("m", "m", "m", "rad", "rad", "rad", "1"),
    low=(-0.04,) * 3 + (-0.25,) * 3 + (0.0,),
    high=(0.04,) * 3 + (0.25,) * 3 + (1.0,),
    control_hz=10.0,
    robot=ARM,
)

ROBOT = JointLimits(
    joints=list(JOINTS),
    grippers=[],
    low=JOINT_LOW.tolist(),
    high=JOINT_HIGH.tolist(),
    speed=[2.0] * 7,
    acceleration=[50.0] * 7,
    fingers=["left", "right"],
    finger_open=[0.04, 0.04],
    finger_closed=[0.0, 0.0],
    widest=0.08,
    margin=0.05,
    overshoot=0.01,
    speed_share=1.0,
    acceleration_share=1.0,
)

NO_FINGERS: dict[str, Any] = {"fingers": [], "finger_open": [], "finger_closed": [], "widest": None}

SAFETY = Safety(
    image_age=0.3,
    joints_age=0.2,
    inference=0.3,
    instruction=60.0,
    tracking=0.2,
    tracking_for=0.5,
    fresh_frames=3,
    rejected=3,
    workspace=((0.25, -0.4, 0.008), (0.75, 0.4, 0.5)),
)

FORWARD = np.array([[0.01, 0, 0, 0, 0, 0, 1.0]], np.float32)  # 1 cm along x, gripper open
