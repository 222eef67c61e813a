"""Axes about the robot: where it starts, what it looks like, how its motors and sensors err."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.tasks.bound import BoundScene, Noise
from vla.tasks.control import DOWN, HOME, MAX_OPENING, rotation_z, solve
from vla.tasks.randomize.axis import Angles, Lengths, Places, rounded
from vla.types import NonNegativeRange, PositiveRange, Share


class Arm:
    """Where the gripper starts, how far it is turned, and how far open it is."""

    def __init__(
        self,
        x: Places,
        y: Places,
        z: Places,
        yaw: Angles = (0.0, 0.0),
        opening: Lengths = (MAX_OPENING, MAX_OPENING),
    ) -> None:
        """Args: ranges of the tool point in the base frame [m], its yaw [rad] and the gripper's opening [m]."""
        self.x, self.y, self.z, self.yaw, self.opening = x, y, z, yaw, opening

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a pose and put the joints there."""
        position = np.array([random_state.uniform(*bounds) for bounds in (self.x, self.y, self.z)])
        yaw, opening = random_state.uniform(*self.yaw), random_state.uniform(*self.opening)
        target = np.eye(4)
        target[:3, 3], target[:3, :3] = position, rotation_z(yaw) @ DOWN
        scene.place_arm(solve(target, HOME), opening)
        return {"tcp": rounded(position), "yaw": round(yaw, 5), "opening": round(opening, 5)}


class Robot:
    """Colours of the robot's shell."""

    def __init__(self, shade: NonNegativeRange, tint: Share = 0.0) -> None:
        """Args: range of the factor on its brightness; largest change of each channel."""
        self.shade, self.tint = shade, tint

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a colour that all of its parts take on."""
        factor = random_state.uniform(*self.shade) + random_state.uniform(-self.tint, self.tint, 3)
        rgb = scene.model.geom_rgba[scene.robot_geoms, :3] * factor
        scene.model.geom_rgba[scene.robot_geoms, :3] = np.clip(rgb, 0, 1)
        return {"factor": rounded(factor)}


class Gains:
    """Strength of each joint's servo."""

    def __init__(self, factor: PositiveRange) -> None:
        """Args: range of the factor on stiffness and damping."""
        self.factor = factor

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a factor per joint."""
        factors = random_state.uniform(*self.factor, len(scene.arm_actuators))
        scene.model.actuator_gainprm[scene.arm_actuators, 0] *= factors
        scene.model.actuator_biasprm[scene.arm_actuators, 1:3] *= factors[:, None]
        return {"factor": rounded(factors)}


class Latency:
    """Time from a command to the motors."""

    def __init__(self, seconds: NonNegativeRange) -> None:
        """Args: its range [s]."""
        self.seconds = seconds

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw it."""
        scene.latency = float(random_state.uniform(*self.seconds))
        return {"seconds": round(scene.latency, 5)}


class Sensors:
    """Noise of cameras and joint encoders."""

    def __init__(
        self, image: NonNegativeRange, joints: NonNegativeRange = (0.0, 0.0), gripper: NonNegativeRange = (0.0, 0.0)
    ) -> None:
        """Args: ranges of the standard deviations, of colour channels 0…255, joints [rad] and opening [m]."""
        self.image, self.joints, self.gripper = image, joints, gripper

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw how much."""
        image, joints, gripper = (random_state.uniform(*bounds) for bounds in (self.image, self.joints, self.gripper))
        scene.noise = Noise(image, joints, gripper)
        return {"image": round(image, 3), "joints": round(joints, 6), "gripper": round(gripper, 6)}
