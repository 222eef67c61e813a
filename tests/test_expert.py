"""The scripted expert solves its goals, and labels what it is pushed into with what it would have done."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import make_tabletop

from vla.rollout import rollout
from vla.tasks.expert import Perturbation, Waypoint

if TYPE_CHECKING:
    from vla.tasks.tabletop import Tabletop


GOALS = ("lift", "pick_place", "pick_place_two", "push", "stack", "stay")


@pytest.mark.parametrize("goal", GOALS)
@pytest.mark.parametrize("perturbed", [False, True])
def test_the_expert_solves_every_goal(goal: str, perturbed: bool) -> None:
    environment = make_tabletop(f"goal={goal}")
    expert = Waypoint(environment.spec, Perturbation() if perturbed else None)
    with environment.blind():
        episodes = [rollout(environment, expert, seed) for seed in range(12)]
    environment.close()
    assert sum(episode.success for episode in episodes) >= (11 if perturbed else 12)


@pytest.mark.parametrize("goal", GOALS)
def test_wide_randomisation_is_within_the_experts_reach(goal: str) -> None:
    environment = make_tabletop(f"goal={goal}", "randomize=wide")
    expert = Waypoint(environment.spec)
    with environment.blind():
        outcomes = [rollout(environment, expert, seed).outcome for seed in range(10)]
    environment.close()
    assert outcomes.count("success") >= 9


def test_the_clean_action_is_recorded_where_another_one_is_executed(tabletop: Tabletop) -> None:
    expert = Waypoint(tabletop.spec, Perturbation(start=1.0, noise=0.0, rate=0.0, start_steps=(4, 4)))
    with tabletop.blind():
        episode = rollout(tabletop, expert, 3)
    differs = (episode.actions != episode.executed).any(axis=1)
    assert differs[:4].all() and not differs[4:].any()


def test_a_grasp_that_is_made_to_miss_is_made_good(tabletop: Tabletop) -> None:
    expert = Waypoint(tabletop.spec, Perturbation(start=0.0, noise=0.0, rate=0.0, missed=1.0))
    with tabletop.blind():
        episode = rollout(tabletop, expert, 3)
    beside = (episode.actions[:, :2] != episode.executed[:, :2]).any(axis=1)
    assert episode.success and beside.sum() >= 3
    assert (episode.executed[beside, 6] == 0).all()


def test_a_slow_episode_executes_a_share_of_its_motions_and_labels_the_whole(tabletop: Tabletop) -> None:
    quiet = Perturbation(start=0.0, noise=0.0, rate=0.0, unturned=0.0, missed=0.0)
    slow = Perturbation(start=0.0, noise=0.0, rate=0.0, unturned=0.0, missed=0.0, pace=(0.4, 0.5))
    with tabletop.blind():
        at_once, slowly = (rollout(tabletop, Waypoint(tabletop.spec, each), 3) for each in (quiet, slow))
    assert slowly.success and len(slowly.actions) > 1.3 * len(at_once.actions)
    np.testing.assert_array_equal(slowly.actions[0], at_once.actions[0])
    moved = np.abs(slowly.actions[:, :6]) > 1e-4
    shares = slowly.executed[:, :6][moved] / slowly.actions[:, :6][moved]
    assert shares.min() >= 0.4 and shares.max() <= 0.5 and np.ptp(shares) < 1e-3
    np.testing.assert_array_equal(slowly.executed[:, 6], slowly.actions[:, 6])


def test_labels_depend_on_the_state_alone(tabletop: Tabletop) -> None:
    """A fresh expert, shown a state from the middle of an episode, says what the one that lived through it said."""
    with tabletop.blind():
        episode = rollout(tabletop, Waypoint(tabletop.spec, Perturbation()), 8)
    for observation, action in zip(episode.observations, episode.actions, strict=True):
        np.testing.assert_array_equal(Waypoint(tabletop.spec).act(observation), action)


def test_actions_stay_within_the_spec(tabletop: Tabletop) -> None:
    with tabletop.blind():
        episode = rollout(tabletop, Waypoint(tabletop.spec, Perturbation(noise=1.0)), 2)
    for actions in (episode.actions, episode.executed):
        assert (actions >= np.array(tabletop.spec.low, np.float32)).all()
        assert (actions <= np.array(tabletop.spec.high, np.float32)).all()


def test_without_the_simulators_truth_the_expert_says_so(tabletop: Tabletop) -> None:
    observation = dataclasses.replace(tabletop.reset(0), truth=None)
    with pytest.raises(ValueError, match="truth"):
        Waypoint(tabletop.spec).act(observation)
