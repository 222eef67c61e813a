"""The classifier names what a person would say who watched the episode."""

from __future__ import annotations

import numpy as np
from tabletop_states import state

from vla.tasks.tabletop.goals.goal import Skill, Subgoal
from vla.tasks.tabletop.outcome import OutcomeClassifier


def step(
    classifier: OutcomeClassifier,
    height: float = 0.02,
    held: bool = False,
    near: bool = True,
    reached: bool = False,
    skill: Skill = "place",
) -> None:
    """One step with the named block's centre at `height`."""
    positions = np.array([[0.5, 0.0, height], [0.4, 0.2, 0.02]])
    seen = state(positions, held=[held, False], tool=positions[0] if near else positions[0] + 0.2)
    classifier.update(seen, [Subgoal(0, np.zeros(3), skill, reached)], named=[0])


def test_success_must_be_held() -> None:
    classifier = OutcomeClassifier(hold_steps=3)
    for reached in (True, True, False, True, True):
        step(classifier, reached=reached)
    assert not classifier.success
    step(classifier, reached=True)
    assert classifier.outcome == "success"


def test_failures_are_told_apart() -> None:
    classifier = OutcomeClassifier(3)
    step(classifier, near=False)
    assert classifier.outcome == "never_reached"
    step(classifier)
    assert classifier.outcome == "missed_grasp" and classifier.milestones == frozenset()
    step(classifier, height=0.12, held=True)
    assert classifier.outcome == "timeout" and classifier.milestones == {"grasped"}
    step(classifier, height=0.10, near=False)
    assert classifier.outcome == "dropped"
    step(classifier, height=0.05, held=True)
    step(classifier, height=0.02)
    assert classifier.outcome == "not_placed" and classifier.milestones == {"grasped"}


def test_a_block_that_is_put_down_on_a_tall_one_was_not_dropped() -> None:
    for height, outcome in ((0.085, "not_placed"), (0.15, "dropped")):  # of its centre, above a top at 6 cm
        classifier, pair = OutcomeClassifier(3), [Subgoal(0, np.zeros(3), "place", False)]
        positions = np.array([[0.41, 0.0, height], [0.4, 0.0, 0.04]])
        for held in (True, False):
            classifier.update(state(positions, held=[held, False], tool=positions[0]), pair, named=[0, 1])
        assert classifier.outcome == outcome


def test_lifting_another_block_is_the_wrong_object() -> None:
    classifier = OutcomeClassifier(3)
    positions = np.array([[0.5, 0.0, 0.02], [0.4, 0.2, 0.12]])
    seen = state(positions, held=[False, True], tool=positions[1])
    classifier.update(seen, [Subgoal(0, np.zeros(3), "place", False)], named=[0])
    assert classifier.outcome == "wrong_object" and classifier.milestones == frozenset()


def test_what_was_pushed_astray_was_not_missed() -> None:
    classifier = OutcomeClassifier(3)
    step(classifier, skill="push", near=False)
    assert classifier.milestones == frozenset()
    step(classifier, skill="push")
    assert classifier.outcome == "not_placed" and classifier.milestones == {"reached"}


def test_with_two_subgoals_it_is_about_the_one_whose_turn_it_is() -> None:
    classifier = OutcomeClassifier(3)
    positions = np.array([[0.5, 0.0, 0.12], [0.4, 0.2, 0.02]])
    lifted = state(positions, held=[True, False], tool=positions[0])
    first, second = (Subgoal(block, np.zeros(3), "place", False) for block in (0, 1))
    classifier.update(lifted, [first, second], named=[0, 1])
    assert classifier.outcome == "timeout"
    done = Subgoal(0, np.zeros(3), "place", True)
    positions = np.array([[0.5, 0.0, 0.02], [0.4, 0.2, 0.02]])
    classifier.update(state(positions, tool=positions[0]), [done, second], named=[0, 1])
    assert classifier.outcome == "never_reached"


def test_acting_on_a_stay_goal_is_did_not_stay() -> None:
    classifier = OutcomeClassifier(3)
    step(classifier, height=0.12, held=True, skill="stay")
    assert classifier.outcome == "did_not_stay" and classifier.milestones == frozenset()
