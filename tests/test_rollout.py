"""An episode plays again from its actions, and where it does not, it says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
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


class InTwo(ToyEnvironment):
    """Gives a second instruction at some time, for which a policy must look."""

    instructions, completed = 2, 0


@pytest.mark.parametrize(("world", "planned"), [(InTwo, True), (ToyEnvironment, False)])
def test_images_are_left_out_only_where_no_one_could_need_them(world: type[ToyEnvironment], planned: bool) -> None:
    class Planning(ToyExpert):
        @property
        def planned(self) -> bool:
            return planned

    episode = rollout(world(), Planning(), 1, all_images=False)
    assert all(observation.rgb for observation in episode.observations)
