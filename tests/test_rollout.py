"""An episode plays again from its actions, and where it does not, it says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import ToyEnvironment, ToyExpert

from vla.rollouts.rollout import replay, rollout
from vla.spec import Observation

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


class Planning(ToyExpert):
    """Looks once in a hundred steps, and when there is a new instruction."""

    planned = True


class Changing(ToyEnvironment):
    """Asks for something else after five steps."""

    def _look(self) -> Observation:
        return replace(super()._look(), instruction="go" if self._steps < 5 else "go on")


@pytest.mark.parametrize(("world", "seen"), [(ToyEnvironment, 1), (Changing, STEPS)])
def test_images_are_left_out_only_where_no_one_could_need_them(world: type[ToyEnvironment], seen: int) -> None:
    episode = rollout(world(), Planning(), 1, all_images=False)
    assert [bool(observation.rgb) for observation in episode.observations] == [True] * seen + [False] * (STEPS - seen)
