"""Randomizers of the robot: start pose, appearance, actuators and sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vla.io.types import NonNegativeRange, PositiveRange, Share
from vla.robots.cartesian import DOWN, rotation_z, solve
from vla.tasks.tabletop.compiled_scene import CompiledScene, Noise
from vla.tasks.tabletop.randomize.randomizer import Angles, Lengths, Places, round_values


@dataclass(frozen=True)
class Arm:
    """Start position, yaw and opening of the gripper."""

    x: Places  # range of the tool point in the base frame [m]
    y: Places
    z: Places
    yaw: Angles  # range of its yaw [rad]
    opening: Lengths  # range of the gripper's opening [m]

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a pose and set the joints by inverse kinematics."""
        position = np.array([random_state.uniform(*bounds) for bounds in (self.x, self.y, self.z)])
        yaw, opening = random_state.uniform(*self.yaw), random_state.uniform(*self.opening)
        target = np.eye(4)
        target[:3, 3], target[:3, :3] = position, rotation_z(yaw) @ DOWN
        arm = scene.robot.kinematics
        scene.place_arm(solve(arm, target, arm.home), opening)
        return {"tcp": round_values(position), "yaw": round(yaw, 5), "opening": round(opening, 5)}


@dataclass(frozen=True)
class RobotColour:
    """Colours of the robot's shell."""

    shade: NonNegativeRange  # range of the factor on its brightness
    tint: Share  # maximum change of each channel

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw one colour factor for all parts."""
        factor = random_state.uniform(*self.shade) + random_state.uniform(-self.tint, self.tint, 3)
        rgb = scene.model.geom_rgba[scene.robot_geoms, :3] * factor
        scene.model.geom_rgba[scene.robot_geoms, :3] = np.clip(rgb, 0, 1)
        return {"factor": round_values(factor)}


@dataclass(frozen=True)
class Gains:
    """Strength of each joint's servo."""

    factor: PositiveRange  # range of the factor on stiffness and damping

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a factor per joint."""
        factors = random_state.uniform(*self.factor, len(scene.arm_actuators))
        scene.model.actuator_gainprm[scene.arm_actuators, 0] *= factors
        scene.model.actuator_biasprm[scene.arm_actuators, 1:3] *= factors[:, None]
        return {"factor": round_values(factors)}


@dataclass(frozen=True)
class Latency:
    """Latency of motor commands."""

    seconds: NonNegativeRange  # range of the latency [s]

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw the latency."""
        scene.latency = float(random_state.uniform(*self.seconds))
        return {"seconds": round(scene.latency, 5)}


@dataclass(frozen=True)
class Sensors:
    """Noise of cameras and joint encoders."""

    image: NonNegativeRange  # range of the standard deviation of colour channels, 0…255
    joints: NonNegativeRange  # of joint positions [rad]
    gripper: NonNegativeRange  # of the opening [m]

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw the standard deviations."""
        image, joints, gripper = (random_state.uniform(*bounds) for bounds in (self.image, self.joints, self.gripper))
        scene.noise = Noise(image, joints, gripper)
        return {"image": round(image, 3), "joints": round(joints, 6), "gripper": round(gripper, 6)}
