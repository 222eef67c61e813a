"""Kinematics against MuJoCo's, inverse kinematics against itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pytest

from vla.robots.cartesian import (
    DOWN,
    CartesianController,
    rotation_from_vector,
    rotation_z,
    solve,
    vector_from_rotation,
)
from vla.robots.panda import HOME, JOINT_HIGH, JOINT_LOW, JOINT_SPEED, PANDA, forward

if TYPE_CHECKING:
    from vla.tasks.tabletop.environment import Tabletop


@pytest.mark.parametrize("seed", range(5))
def test_forward_kinematics_and_jacobian_equal_mujocos(tabletop: Tabletop, seed: int) -> None:
    compiled = tabletop.simulation.compiled
    data = mujoco.MjData(compiled.model)
    joints = np.random.default_rng(seed).uniform(JOINT_LOW, JOINT_HIGH)
    data.qpos[compiled.joints] = joints
    mujoco.mj_kinematics(compiled.model, data)
    mujoco.mj_comPos(compiled.model, data)
    linear, angular = np.empty((3, compiled.model.nv)), np.empty((3, compiled.model.nv))
    mujoco.mj_jacSite(compiled.model, data, linear, angular, compiled.tcp)
    pose, jacobian = forward(joints)
    np.testing.assert_allclose(pose[:3, 3], data.site_xpos[compiled.tcp], atol=1e-6)
    np.testing.assert_allclose(pose[:3, :3].ravel(), data.site_xmat[compiled.tcp], atol=1e-6)
    np.testing.assert_allclose(jacobian, np.concatenate([linear, angular])[:, compiled.velocities], atol=1e-6)


def test_an_arm_is_driven_at_rates_of_whole_physics_steps(tabletop: Tabletop) -> None:
    tabletop.reset(0)
    tabletop.drive(HOME, 1.0, 1 / 50)
    before = tabletop.simulation.compiled.data.time
    for rate in (100, 500):
        with pytest.raises(ValueError, match=f"cannot be driven at {rate} Hz, as physics runs at 250 Hz"):
            tabletop.drive(HOME, 1.0, 1 / rate)
    assert tabletop.simulation.compiled.data.time == before


def test_rotation_vectors_are_inverse_to_rotations() -> None:
    vector = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-12)
    np.testing.assert_allclose(rotation_from_vector([0, 0, 0.4]), rotation_z(0.4), atol=1e-12)
    np.testing.assert_array_equal(vector_from_rotation(np.eye(3)), np.zeros(3))


@pytest.mark.parametrize("position", [(0.38, -0.2, 0.02), (0.62, 0.2, 0.02), (0.5, 0.0, 0.3), (0.35, 0.25, 0.35)])
def test_solve_reaches_the_workspace(position: tuple[float, float, float]) -> None:
    target = np.eye(4)
    target[:3, 3], target[:3, :3] = position, rotation_z(0.5) @ DOWN
    joints = solve(PANDA, target, HOME)
    for _ in range(3):  # far from home, a few more steps are needed
        joints = solve(PANDA, target, joints)
    pose = forward(joints)[0]
    assert np.linalg.norm(pose[:3, 3] - position) < 1e-3
    assert np.linalg.norm(vector_from_rotation(target[:3, :3] @ pose[:3, :3].T)) < 1e-2


def test_controller_keeps_joint_limits_and_speed_limits() -> None:
    low, high = np.array([0.25, -0.4, 0.01]), np.array([0.75, 0.4, 0.5])
    controller = CartesianController(PANDA, 0.1, low, high)
    controller.reset(HOME)
    random = np.random.default_rng(0)
    for _ in range(200):
        before = controller.joints.copy()
        after = controller.step(random.uniform(-1, 1, 6) * [0.2, 0.2, 0.2, 0.5, 0.5, 0.5])
        assert (np.abs(after - before) <= JOINT_SPEED * 0.1 + 1e-9).all()
        assert (after >= JOINT_LOW).all() and (after <= JOINT_HIGH).all()


def test_deltas_are_anchored_on_the_commanded_pose() -> None:
    controller = CartesianController(PANDA, 0.1, (-1, -1, -1), (1, 1, 1))
    controller.reset(HOME)
    start = controller.pose[:3, 3].copy()
    for _ in range(5):
        controller.step(np.array([0.01, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(controller.pose[:3, 3] - start, [0.05, 0, 0], atol=1e-3)
