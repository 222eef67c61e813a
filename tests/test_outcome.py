"""The judge names what a person would say who watched the episode."""

from __future__ import annotations

import numpy as np
from test_goals import facts

from vla.tasks.goals.goal import Manner, Subgoal
from vla.tasks.outcome import Judge


def step(
    judge: Judge,
    height: float = 0.02,
    held: bool = False,
    near: bool = True,
    reached: bool = False,
    manner: Manner = "place",
) -> None:
    """One step with the named block's centre at `height`."""
    positions = np.array([[0.5, 0.0, height], [0.4, 0.2, 0.02]])
    seen = facts(positions, held=[held, False], tool=positions[0] if near else positions[0] + 0.2)
    judge.watch(seen, [Subgoal(0, np.zeros(3), manner, reached)], named=[0])


def test_success_must_be_held() -> None:
    judge = Judge(hold_steps=3)
    for reached in (True, True, False, True, True):
        step(judge, reached=reached)
    assert not judge.success
    step(judge, reached=True)
    assert judge.outcome == "success"


def test_failures_are_told_apart() -> None:
    judge = Judge(3)
    step(judge, near=False)
    assert judge.outcome == "never_reached"
    step(judge)
    assert judge.outcome == "missed_grasp"
    step(judge, height=0.12, held=True)
    assert judge.outcome == "timeout"
    step(judge, height=0.10, near=False)
    assert judge.outcome == "dropped"
    step(judge, height=0.05, held=True)
    step(judge, height=0.02)
    assert judge.outcome == "not_placed"


def test_lifting_another_block_is_the_wrong_object() -> None:
    judge = Judge(3)
    positions = np.array([[0.5, 0.0, 0.02], [0.4, 0.2, 0.12]])
    seen = facts(positions, held=[False, True], tool=positions[1])
    judge.watch(seen, [Subgoal(0, np.zeros(3), "place", False)], named=[0])
    assert judge.outcome == "wrong_object"


def test_what_was_pushed_astray_was_not_missed() -> None:
    judge = Judge(3)
    step(judge, manner="push")
    assert judge.outcome == "not_placed"


def test_with_two_subgoals_it_is_about_the_one_whose_turn_it_is() -> None:
    judge = Judge(3)
    positions = np.array([[0.5, 0.0, 0.12], [0.4, 0.2, 0.02]])
    lifted = facts(positions, held=[True, False], tool=positions[0])
    first, second = (Subgoal(block, np.zeros(3), "place", False) for block in (0, 1))
    judge.watch(lifted, [first, second], named=[0, 1])
    assert judge.outcome == "timeout"
    done = Subgoal(0, np.zeros(3), "place", True)
    positions = np.array([[0.5, 0.0, 0.02], [0.4, 0.2, 0.02]])
    judge.watch(facts(positions, tool=positions[0]), [done, second], named=[0, 1])
    assert judge.outcome == "never_reached"


def test_who_should_have_stayed_did_not() -> None:
    judge = Judge(3)
    step(judge, height=0.12, held=True, manner="stay")
    assert judge.outcome == "did_not_stay"
