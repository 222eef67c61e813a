"""An episode plays again from its actions, and where it does not, it says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from toy import ToyEnvironment, ToyExpert

from vla.rollouts.rollout import replay, rollout

EPISODE = rollout(ToyEnvironment(), ToyExpert(), 1)
STEPS = len(EPISODE.executed)


def test_a_replay_goes_where_the_rollout_went() -> None:
    assert replay(ToyEnvironment(), EPISODE) is None


def test_the_first_step_that_differs_is_told() -> None:
    assert replay(ToyEnvironment(forgetful=True), EPISODE) == 0
    executed = EPISODE.executed.copy()
    executed[4] += 0.01
    assert replay(ToyEnvironment(), replace(EPISODE, executed=executed)) == 5


def test_another_end_differs_even_if_all_joints_are_the_same() -> None:
    assert replay(ToyEnvironment(), replace(EPISODE, outcome="timeout")) == STEPS
    short = replace(EPISODE, observations=EPISODE.observations[:-1], executed=EPISODE.executed[:-1])
    assert replay(ToyEnvironment(), short) == STEPS - 1
    longer = [*EPISODE.observations, EPISODE.observations[-1]]
    executed = np.concatenate([EPISODE.executed, EPISODE.executed[-1:]])
    assert replay(ToyEnvironment(), replace(EPISODE, observations=longer, executed=executed)) == STEPS
