"""Commands keep to the limits, whatever is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vla.deploy.governor import Governor, Robot

PERIOD = 0.02
ROBOT = Robot(
    joints=["a", "b"],
    low=[-1.0, -2.0],
    high=[1.0, 2.0],
    speed=[2.0, 1.0],
    acceleration=[10.0, 5.0],
    fingers=[],
    speed_share=0.5,
    acceleration_share=0.5,
)


@pytest.fixture
def governor() -> Governor:
    governor = Governor(ROBOT, PERIOD)
    governor.start(np.zeros(2))
    return governor


def assert_within_limits(commands: list[np.ndarray]) -> None:
    """Position, speed and acceleration of a series of commands that begins at rest."""
    positions = np.array(commands)
    velocities = np.diff(positions, axis=0, prepend=positions[:1]) / PERIOD
    accelerations = np.diff(velocities, axis=0, prepend=np.zeros((1, 2))) / PERIOD
    assert (positions >= ROBOT.lowest - 1e-9).all() and (positions <= ROBOT.highest + 1e-9).all()
    assert (np.abs(velocities) <= ROBOT.fastest + 1e-9).all()
    assert (np.abs(accelerations) <= ROBOT.hardest + 1e-6).all()


@pytest.mark.parametrize("seed", range(5))
def test_limits_hold_for_random_goals(governor: Governor, seed: int) -> None:
    random = np.random.default_rng(seed)
    commands = [governor.position]
    for _ in range(400):
        goal, remaining = random.uniform(-5, 5, 2), random.uniform(-0.1, 0.3)
        commands.append(governor.brake() if random.uniform() < 0.1 else governor.step(goal, remaining))
    assert_within_limits(commands)


def test_limits_hold_against_the_end_of_the_range(governor: Governor) -> None:
    commands = [governor.position] + [governor.step(np.array([9.0, -9.0])) for _ in range(300)]
    assert_within_limits(commands)
    np.testing.assert_allclose(commands[-1], [ROBOT.highest[0], ROBOT.lowest[1]], atol=1e-3)


def test_a_goal_is_reached_when_it_is_due_and_not_overshot(governor: Governor) -> None:
    goal, due = np.array([0.02, -0.02]), 0.3
    commands = [governor.step(goal, due - tick * PERIOD) for tick in range(60)]
    assert np.abs(commands[14] - goal).max() < 0.005
    np.testing.assert_allclose(commands[-1], goal, atol=1e-6)
    assert commands[-1][0] <= max(command[0] for command in commands) <= goal[0] + 1e-9


def test_braking_ends_at_rest_within_what_the_acceleration_allows(governor: Governor) -> None:
    for _ in range(50):
        governor.step(np.array([0.9, 1.9]))
    ticks = int(np.ceil((np.abs(governor.velocity) / ROBOT.hardest).max() / PERIOD))
    assert ticks > 3
    for _ in range(ticks):
        governor.brake()
    assert governor.resting


def test_a_speed_limit_that_is_lowered_on_the_way_is_reached_by_braking(governor: Governor) -> None:
    for _ in range(50):
        governor.step(np.array([0.9, 1.9]))
    fast = governor.velocity
    governor.robot = replace(ROBOT, speed_share=0.1)
    steps = [fast, *(governor.velocity for _ in range(30) if governor.step(np.array([0.9, 1.9])) is not None)]
    assert (np.abs(np.diff(steps, axis=0)) <= ROBOT.hardest * PERIOD + 1e-9).all()
    assert (np.abs(fast) > governor.robot.fastest).any() and (np.abs(steps[-1]) <= governor.robot.fastest + 1e-9).all()


def test_the_first_command_is_the_measured_pose() -> None:
    governor = Governor(ROBOT, PERIOD)
    governor.start(np.array([0.3, -0.4]))
    np.testing.assert_array_equal(governor.brake(), [0.3, -0.4])


def test_an_arm_outside_its_limits_is_not_taken_over() -> None:
    with pytest.raises(ValueError, match=r"b stands at 1\.990 rad, outside -1\.950 to 1\.950"):
        Governor(ROBOT, PERIOD).start(np.array([0.0, 1.99]))


@pytest.mark.parametrize("wrong", [{"low": [0.0]}, {"speed_share": 0.0}, {"acceleration_share": 1.5}])
def test_a_robot_that_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=r"deploy\.robot"):
        replace(ROBOT, **wrong)
