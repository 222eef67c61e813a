"""What counts as reaching a goal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tabletop_states import HALF, state

from vla.spec import Array
from vla.tasks.tabletop.goals.goal import Goal, Referents, WorldState
from vla.tasks.tabletop.goals.several import Mixed
from vla.tasks.tabletop.goals.skills import Lift, PickPlace, PickPlaceTwo, Place, Push, Stack, Stay, Wait
from vla.tasks.tabletop.language import Grammar

GRAMMAR = Grammar(["{move} {block}"], {"move": ["move"]}, ["{block}"], {"move": ["shift"]}, [])
COMMON: Any = {"language": GRAMMAR, "hold_steps": 3}


def reached(goal: Goal, referents: Referents, seen: WorldState) -> bool:
    return all(subgoal.done for subgoal in goal.subgoals(seen, referents))


def at(*places: tuple[float, float, float]) -> Array:
    return np.array(places)


def test_a_block_is_lifted_while_it_is_held_high_enough() -> None:
    goal, referents = Lift(**COMMON, height=0.1), Referents((0,), (0,))
    assert reached(goal, referents, state(at((0.4, 0.2, 0.13)), held=[True]))
    assert not reached(goal, referents, state(at((0.4, 0.2, 0.11)), held=[True]))
    assert not reached(goal, referents, state(at((0.4, 0.2, 0.13))))


def test_a_block_is_placed_once_it_rests_on_the_pad_and_is_let_go() -> None:
    goal, referents = PickPlace(**COMMON, radius=0.04), Referents((0,), (0,))
    there = at((0.53, 0.0, HALF))
    assert reached(goal, referents, state(there))
    assert not reached(goal, referents, state(there, held=[True]))
    assert not reached(goal, referents, state(there, speed=0.1))
    assert not reached(goal, referents, state(at((0.55, 0.0, HALF))))
    assert not reached(goal, referents, state(at((0.53, 0.0, 0.07))))


def test_a_tower_is_one_block_resting_on_the_named_other_one() -> None:
    goal, referents = Stack(**COMMON), Referents((1, 0), (0,))
    lower = (0.5, 0.0, HALF)
    assert reached(goal, referents, state(at(lower, (0.51, 0.0, 3 * HALF))))
    assert not reached(goal, referents, state(at(lower, (0.53, 0.0, 3 * HALF))))  # its centre is over the edge
    assert not reached(goal, referents, state(at(lower, (0.51, 0.0, HALF))))
    assert not reached(goal, Referents((0, 1), (0,)), state(at(lower, (0.51, 0.0, 3 * HALF))))
    np.testing.assert_allclose(goal.subgoals(state(at(lower, lower)), referents)[0].destination, (0.5, 0.0, 3 * HALF))


def test_a_block_that_was_carried_was_not_pushed() -> None:
    goal, referents = Push(**COMMON, radius=0.04, highest=0.02), Referents((0,), (1, 0))
    there = at((0.5, 0.18, HALF))
    assert reached(goal, referents, state(there))
    assert not reached(goal, referents, state(there, lifts=[0.05]))
    assert not reached(goal, Referents((0,), (0, 1)), state(there))


def test_two_blocks_are_placed_one_after_the_other() -> None:
    goal, referents = PickPlaceTwo(**COMMON, radius=0.04), Referents((0, 1), (1, 0))
    both = at((0.5, 0.2, HALF), (0.5, 0.0, HALF))
    assert reached(goal, referents, state(both))
    assert not reached(goal, Referents((0, 1), (0, 1)), state(both))
    first, second = goal.subgoals(state(both, tool=both[0]), referents)
    assert not first.done and second.done  # the hand is still around the first


def test_staying_is_to_move_no_block_and_to_rest() -> None:
    goal, referents = Stay(GRAMMAR, pads=1), Referents((1,), (0,))
    untouched = state(at((0.4, 0.2, HALF), (0.4, 0.2, HALF)))
    assert reached(goal, referents, untouched)
    assert not reached(goal, referents, replace(untouched, arm_speed=0.2))
    assert not reached(goal, referents, state(at((0.42, 0.2, HALF), (0.4, 0.2, HALF))))


def test_a_mixture_draws_all_of_its_goals_and_needs_the_room_of_the_largest() -> None:
    mixed = Mixed({"lift": Lift(**COMMON, height=0.1), "stack": Stack(**COMMON), "push": None}, 0.0, 0.0)
    drawn = {type(mixed.draw(np.random.RandomState(seed))) for seed in range(20)}
    assert drawn == {Lift, Stack} and mixed.blocks == 3
    with pytest.raises(ValueError, match="names no goal"):
        Mixed({"push": None}, 0.0, 0.0)


def test_a_share_of_a_mixture_demands_to_leave_everything_in_place_and_the_rest_stays_what_it_was() -> None:
    goals: dict[str, Goal | None] = {
        "lift": Lift(**COMMON, height=0.1),
        "place": Place(**COMMON, radius=0.04),
        "wait": Wait(2),
    }
    mixed, without = Mixed(goals, 0.2, 0.1), Mixed(goals, 0.0, 0.0)
    drawn = [[each.draw(np.random.RandomState(seed)) for each in (mixed, without)] for seed in range(1000)]
    drawn = [(goal, other) for goal, other in drawn if not isinstance(other, Wait)]
    stays, waits = (sum(type(goal) is kind for goal, _ in drawn) for kind in (Stay, Wait))
    assert 100 < stays < 170 and 45 < waits < 90
    for goal, other in drawn:
        assert goal is other or (isinstance(goal, Stay) and goal.pads == other.pads)
    assert (mixed.absent, without.absent) == (1, 0)
    with pytest.raises(ValueError, match=r"must be at most 1, not 1\.1"):
        Mixed(goals, 0.6, 0.5)


def test_one_of_two_pads_is_named() -> None:
    goal, referents = Place(**COMMON, radius=0.04), Referents((0,), (1, 0))
    assert reached(goal, referents, state(at((0.5, 0.2, HALF))))
    assert not reached(goal, referents, state(at((0.5, 0.0, HALF))))
