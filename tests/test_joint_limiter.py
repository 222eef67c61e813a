"""Commands keep to the limits, for any goal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import NO_FINGERS
from arm import ROBOT as PANDA
from composing import CONF
from defaults import defaults_of

from vla.deploy.joint_limiter import JointLimiter, JointLimits
from vla.deploy.motion import LEEWAY, _Workspace

PERIOD = 0.02
TWO = {"joints": ["a", "b"], "low": [-1.0, -2.0], "high": [1.0, 2.0], "speed": [2.0, 1.0], "acceleration": [10.0, 5.0]}
ROBOT = replace(PANDA, **TWO, **NO_FINGERS, speed_share=0.5, acceleration_share=0.5)


@pytest.fixture
def limiter() -> JointLimiter:
    limiter = JointLimiter(ROBOT, PERIOD)
    limiter.start(np.zeros(2))
    return limiter


def assert_within_limits(commands: list[np.ndarray]) -> None:
    """Position, speed and acceleration of a series of commands that begins at rest."""
    positions = np.array(commands)
    velocities = np.diff(positions, axis=0, prepend=positions[:1]) / PERIOD
    accelerations = np.diff(velocities, axis=0, prepend=np.zeros((1, 2))) / PERIOD
    assert (positions >= ROBOT.min_position - 1e-9).all() and (positions <= ROBOT.max_position + 1e-9).all()
    assert (np.abs(velocities) <= ROBOT.max_speed + 1e-9).all()
    assert (np.abs(accelerations) <= ROBOT.max_acceleration + 1e-6).all()


@pytest.mark.parametrize("seed", range(2))
def test_limits_hold_for_random_goals(limiter: JointLimiter, seed: int) -> None:
    random = np.random.default_rng(seed)
    commands = [limiter.position]
    for _ in range(400):
        goal, remaining = random.uniform(-5, 5, 2), random.uniform(-0.1, 0.3)
        commands.append(limiter.brake() if random.uniform() < 0.1 else limiter.step(goal, remaining))
    assert_within_limits(commands)


def test_limits_hold_against_the_end_of_the_range(limiter: JointLimiter) -> None:
    commands = [limiter.position] + [limiter.step(np.array([9.0, -9.0])) for _ in range(300)]
    assert_within_limits(commands)
    np.testing.assert_allclose(commands[-1], [ROBOT.max_position[0], ROBOT.min_position[1]], atol=1e-3)


def test_a_goal_is_reached_when_it_is_due_and_not_overshot(limiter: JointLimiter) -> None:
    goal, due = np.array([0.02, -0.02]), 0.3
    commands = [limiter.step(goal, due - tick * PERIOD) for tick in range(60)]
    assert np.abs(commands[14] - goal).max() < 0.005
    np.testing.assert_allclose(commands[-1], goal, atol=1e-6)
    assert commands[-1][0] <= max(command[0] for command in commands) <= goal[0] + 1e-9


def test_braking_ends_at_rest_within_what_the_acceleration_allows(limiter: JointLimiter) -> None:
    for _ in range(50):
        limiter.step(np.array([0.9, 1.9]))
    ticks = int(np.ceil((np.abs(limiter.velocity) / ROBOT.max_acceleration).max() / PERIOD))
    assert ticks > 3
    for _ in range(ticks):
        limiter.brake()
    assert limiter.resting


def test_without_overshoot_a_joint_at_its_goal_stays_there() -> None:
    limiter = JointLimiter(replace(ROBOT, overshoot=0.0), PERIOD)
    np.testing.assert_array_equal(limiter.step(np.zeros(2)), np.zeros(2))
    assert np.isfinite(limiter.step(np.array([0.1, 0.0]))).all()
    for _ in range(100):
        limiter.step(np.array([0.1, 0.0]))
    assert limiter.position == pytest.approx([0.1, 0.0], abs=1e-3)
    limiter.brake()
    assert limiter.resting


@pytest.mark.parametrize(
    "wrong",
    [{"low": [0.0]}, {"low": [1.0, -2.0]}, {"margin": 1.5}, {"joints": ["a", "a"]}, {"grippers": ["c"]}],
    ids=str,
)
def test_limits_that_no_arm_can_have_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=r"deploy\.robot"):
        replace(ROBOT, **wrong)


@pytest.mark.parametrize("robot", sorted(path.stem for path in (CONF / "deploy/robot").glob("*.yaml")))
def test_every_robot_has_limits_of_every_joint(robot: str) -> None:
    arm = JointLimits(**defaults_of(f"deploy/robot/{robot}"))
    assert (arm.min_position < arm.max_position).all() and len({*arm.joints}) == len(arm.joints) == len(arm.low)
    assert (arm.max_speed > 0.3).all() and (arm.max_acceleration > 0.7).all()  # in rad, not in degrees or turns
    assert (arm.max_speed < 7).all() and (np.abs(arm.low) < 7).all() and (np.abs(arm.high) < 7).all()


def test_the_tool_brakes_early_enough_to_stop_within_the_workspace(limiter: JointLimiter) -> None:
    """A tool whose x is the first joint [m], which takes 10 cm to stop from full speed."""

    def forward(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose = np.eye(4)
        pose[0, 3] = joints[0]
        return pose, np.zeros((6, 2))

    workspace = _Workspace(forward, -np.ones(3), np.array([0.4, 1.0, 1.0]))
    commands = [limiter.position.copy()]
    for _ in range(200):
        workspace.step(limiter, np.array([0.9, 0.0]), 0.0)
        commands.append(limiter.position.copy())
    assert 0.35 < np.max(commands) <= 0.4 + LEEWAY
    assert_within_limits(commands)
