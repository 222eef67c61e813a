"""What counts as reaching a goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from vla.spec import Array
from vla.tasks.goals.goal import Aim, Facts, Goal
from vla.tasks.goals.lift import Lift
from vla.tasks.goals.mixed import Mixed
from vla.tasks.goals.pick_place import PickPlace
from vla.tasks.goals.pick_place_two import PickPlaceTwo
from vla.tasks.goals.push import Push
from vla.tasks.goals.stack import Stack
from vla.tasks.goals.stay import Stay
from vla.tasks.language import Grammar

GRAMMAR = Grammar(["move {block}"], {}, ["{block}"], {"move": ["shift"]})
PADS = np.array([[0.5, 0.0, 0.0], [0.5, 0.2, 0.0]])
HALF = 0.02


def facts(
    positions: Array,
    held: Sequence[bool] | None = None,
    tool: Array | None = None,
    speed: float = 0.0,
    lifts: Sequence[float] | None = None,
) -> Facts:
    """Cubes that are held or lie there, and two pads."""
    count = len(positions)
    grip = np.array(held if held is not None else [False] * count)
    return Facts(
        positions=positions,
        starts=np.tile([0.4, 0.2, HALF], (count, 1)),
        extents=np.full((count, 3), HALF),
        speeds=np.full(count, speed),
        lifts=np.array(lifts if lifts is not None else [0.0] * count),
        held=grip,
        touched=grip,
        pads=PADS,
        tool=np.array([0.3, 0.0, 0.3]) if tool is None else tool,
    )


def reached(goal: Goal, aim: Aim, seen: Facts) -> bool:
    return all(subgoal.done for subgoal in goal.subgoals(seen, aim))


def at(*places: tuple[float, float, float]) -> Array:
    return np.array(places)


def test_a_block_is_lifted_while_it_is_held_high_enough() -> None:
    goal, aim = Lift(GRAMMAR, height=0.1), Aim((0,), (0,))
    assert reached(goal, aim, facts(at((0.4, 0.2, 0.13)), held=[True]))
    assert not reached(goal, aim, facts(at((0.4, 0.2, 0.11)), held=[True]))
    assert not reached(goal, aim, facts(at((0.4, 0.2, 0.13))))


def test_a_block_is_placed_once_it_rests_on_the_pad_and_is_let_go() -> None:
    goal, aim = PickPlace(GRAMMAR, radius=0.04), Aim((0,), (0,))
    there = at((0.53, 0.0, HALF))
    assert reached(goal, aim, facts(there))
    assert not reached(goal, aim, facts(there, held=[True]))
    assert not reached(goal, aim, facts(there, speed=0.1))
    assert not reached(goal, aim, facts(at((0.55, 0.0, HALF))))
    assert not reached(goal, aim, facts(at((0.53, 0.0, 0.07))))


def test_a_tower_is_one_block_resting_on_the_named_other_one() -> None:
    goal, aim = Stack(GRAMMAR), Aim((1, 0), (0,))
    lower = (0.5, 0.0, HALF)
    assert reached(goal, aim, facts(at(lower, (0.51, 0.0, 3 * HALF))))
    assert not reached(goal, aim, facts(at(lower, (0.53, 0.0, 3 * HALF))))  # its centre is over the edge
    assert not reached(goal, aim, facts(at(lower, (0.51, 0.0, HALF))))
    assert not reached(goal, Aim((0, 1), (0,)), facts(at(lower, (0.51, 0.0, 3 * HALF))))
    np.testing.assert_allclose(goal.subgoals(facts(at(lower, lower)), aim)[0].destination, (0.5, 0.0, 3 * HALF))


def test_a_block_that_was_carried_was_not_pushed() -> None:
    goal, aim = Push(GRAMMAR), Aim((0,), (1, 0))
    there = at((0.5, 0.18, HALF))
    assert reached(goal, aim, facts(there))
    assert not reached(goal, aim, facts(there, lifts=[0.05]))
    assert not reached(goal, Aim((0,), (0, 1)), facts(there))


def test_two_blocks_are_placed_one_after_the_other() -> None:
    goal, aim = PickPlaceTwo(GRAMMAR), Aim((0, 1), (1, 0))
    both = at((0.5, 0.2, HALF), (0.5, 0.0, HALF))
    assert reached(goal, aim, facts(both))
    assert not reached(goal, Aim((0, 1), (0, 1)), facts(both))
    first, second = goal.subgoals(facts(both, tool=both[0]), aim)
    assert not first.done and second.done  # the hand is still around the first


def test_staying_is_to_move_no_block_and_to_rest() -> None:
    goal, aim = Stay(GRAMMAR), Aim((1,), (0,))
    untouched = facts(at((0.4, 0.2, HALF), (0.4, 0.2, HALF)))
    assert reached(goal, aim, untouched)
    assert not reached(goal, aim, replace(untouched, arm_speed=0.2))
    assert not reached(goal, aim, facts(at((0.42, 0.2, HALF), (0.4, 0.2, HALF))))


def test_a_mixture_draws_all_of_its_goals_and_needs_the_room_of_the_largest() -> None:
    mixed = Mixed({"lift": Lift(GRAMMAR), "stack": Stack(GRAMMAR), "push": None})
    drawn = {type(mixed.draw(np.random.RandomState(seed))) for seed in range(20)}
    assert drawn == {Lift, Stack} and mixed.blocks == 3
    with pytest.raises(ValueError, match="names no goal"):
        Mixed({"push": None})
