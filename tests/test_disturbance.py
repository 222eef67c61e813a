"""What happens in the course of an episode: as drawn, physically sane, reproducible, and made good by the expert."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from typing import Any, get_args

import numpy as np
import pytest
from conftest import make_tabletop

from vla.rollouts.rollout import replay, rollout
from vla.tasks.tabletop.compiled_scene import Kind
from vla.tasks.tabletop.environment import Tabletop
from vla.tasks.tabletop.expert import Waypoint
from vla.tasks.tabletop.goals.goal import WorldState
from vla.tasks.tabletop.randomize.episode import Disturbances

KINDS: tuple[Kind, ...] = get_args(Kind)
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])


@pytest.fixture(scope="module")
def world() -> Iterator[Tabletop]:
    """The default task with disturbances."""
    environment = make_tabletop("task/randomize/disturbance=wide", "task.image_size=[16,16]")
    yield environment
    environment.close()


def only(environment: Tabletop, **changes: Any) -> None:
    """Change what may happen."""
    axes: Any = environment.simulation.randomize
    once: dict[str, Any] = {"times": (1, 1), "delay": (1, 1), "start": (3, 3)}
    axes["disturbance"] = dataclasses.replace(axes["disturbance"], **once, **changes)


def played(environment: Tabletop, seed: int) -> tuple[list[WorldState], int, float]:
    """The states of an episode of the expert, which solves it; the step and the distance of its only disturbance."""
    expert = Waypoint(environment.spec)
    with environment.blind():
        observation = environment.reset(seed)
        states = [environment.simulation.world_state()]
        while not environment.done:
            observation = environment.step(expert.act(observation))
            states.append(environment.simulation.world_state())
    assert environment.outcome == "success"
    [(step, _)] = environment.events
    return states, step, environment.draws["disturbance"]["distance"]


def test_a_moved_target_is_free_and_counts_where_it_is(world: Tabletop) -> None:
    only(world, kinds=["move_target"])
    for seed in range(3):
        states, step, distance = played(world, seed)
        before, after = states[step - 1], states[step]
        (named,) = world.simulation.referents.blocks
        assert "pad" in world.events[0][1] and world.milestones == {"grasped", "disturbed"}
        assert before.held[named] and before.positions[named, 2] > 0.03
        assert math.dist(before.pads[0], after.pads[0]) == pytest.approx(distance, abs=1e-5)
        others = np.delete(after.positions, named, axis=0)
        assert (np.linalg.norm((others - after.pads[0])[:, :2], axis=1) > 0.09).all()
        end = states[-1]
        assert end.away(named, after.pads[0]) < 0.04 and end.away(named, before.pads[0]) > 0.01


def test_a_moved_block_is_free_and_is_found(world: Tabletop) -> None:
    only(world, kinds=["move_block"])
    for seed in range(3):
        states, step, distance = played(world, seed)
        before, after = states[step - 1], states[step]
        (named,) = world.simulation.referents.blocks
        assert math.dist(before.positions[named], after.positions[named]) == pytest.approx(distance, abs=1e-3)
        neighbours = [*np.delete(after.positions, named, axis=0), *after.pads]
        assert min(after.away(named, place) for place in neighbours) > 0.07
        assert not after.touched[named] and after.tool[2] > after.positions[named, 2] + 0.02


def test_a_dropped_block_falls_and_is_grasped_again(world: Tabletop) -> None:
    only(world, kinds=["drop"])
    again = 0
    for seed in range(3):
        states, step, _ = played(world, seed)
        (named,) = world.simulation.referents.blocks
        held = [bool(state.held[named]) for state in states]
        assert held[step] and not any(held[step + 2 : step + 4])
        again += any(held[step + 4 :])
    assert again >= 2  # one may fall onto the pad


def test_a_push_displaces_the_arm_whatever_is_commanded(world: Tabletop) -> None:
    only(world, kinds=["push"], push=(0.1, 0.1))
    task = world.simulation
    with world.blind():
        for action in (STILL, np.array([0.04, 0.04, 0.04, 0, 0, 0, 1.0])):
            world.reset(5)
            at = [task.world_state().tool]
            for number in range(8):
                world.step(action * (number > 3))
                at.append(task.world_state().tool)
                joints, kinematics = task.compiled.data.qpos[task.compiled.joints], task.compiled.robot.kinematics
                assert (joints >= kinematics.lowest).all() and (joints <= kinematics.highest).all()
            [(step, _)] = world.events
            assert step == 4 and math.dist(at[0], at[4]) < 0.003
            assert math.dist(at[4], at[7]) == pytest.approx(0.1, abs=0.005)  # in three steps
            assert math.dist(at[7], at[8]) == pytest.approx(np.linalg.norm(action[:3]), abs=0.01)


def test_an_arm_that_is_driven_is_pushed_and_returns(world: Tabletop) -> None:
    only(world, kinds=["push"], push=(0.1, 0.1))
    task = world.simulation
    with world.blind():
        world.reset(5)
        joints, at = task.compiled.data.qpos[task.compiled.joints].copy(), []
        for _ in range(12):
            at.append(task.world_state().tool)
            for _ in range(5):
                world.drive(joints, 1.0, 0.02)
            world.judge()
    away = [math.dist(at[0], place) for place in at]
    assert max(away[:5]) < 0.003 and max(away) == pytest.approx(0.1, abs=0.02) and away[-1] < 0.005


@pytest.mark.parametrize("kind", KINDS)
def test_a_disturbed_episode_is_replayed_bit_for_bit_and_differs_from_an_undisturbed_one(
    world: Tabletop, kind: Kind
) -> None:
    only(world, kinds=[kind])
    axes: Any = world.simulation.randomize
    with world.blind():
        episode = rollout(world, Waypoint(world.spec), 2)
        events, draws = world.events, world.draws
        assert replay(world, episode).first_difference is None and world.events == events
        kept, axes["disturbance"] = axes["disturbance"], None
        try:
            [(step, _)], differs = events, replay(world, episode).first_difference
            assert differs is not None and differs >= step - 1  # until then, nothing has changed
            assert {**world.draws, "disturbance": draws["disturbance"]} == draws and not world.events
        finally:
            axes["disturbance"] = kept


def test_draws_are_plain_and_keep_kind_time_and_direction_from_level_to_level(world: Tabletop) -> None:
    only(world, kinds=KINDS)
    axes: Any = world.simulation.randomize
    axis = axes["disturbance"]
    stronger: Disturbances = dataclasses.replace(axis, push=(0.3, 0.4), move=(0.3, 0.4))
    compiled, found = world.simulation.compiled, []
    for seed in range(40):
        first, second = (one(compiled, np.random.RandomState(seed)) for one in (axis, stronger))
        assert json.loads(json.dumps(first)) == first and first["times"] == 1
        assert {**second, "distance": first["distance"]} == first
        found.append(first["kind"])
    assert set(found) == set(KINDS)
    never = dataclasses.replace(axis, times=(0, 0))
    with world.blind():
        axes["disturbance"] = never
        world.reset(0)
    assert world.draws["disturbance"]["kind"] == "none" and compiled.disturbance is None
    axes["disturbance"] = axis


def test_impossible_instructions_stay_possible_to_follow() -> None:
    environment = make_tabletop("task/goal=stay", "task/randomize/disturbance=hard")
    only(environment, kinds=["push"], push=(0.2, 0.2))
    for seed in range(2):
        played(environment, seed)
    environment.close()
