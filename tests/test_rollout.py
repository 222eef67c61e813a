"""An episode plays again from its actions, and where it does not, it says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import ToyEnvironment, ToyExpert

from vla.rollouts.rollout import replay, rollout
from vla.spec import Array, Observation

EPISODE = rollout(ToyEnvironment(), ToyExpert(), 1)
STEPS = len(EPISODE.executed)


def test_a_replay_goes_where_the_rollout_went() -> None:
    assert replay(ToyEnvironment(), EPISODE).first_difference is None


def test_the_first_step_that_differs_is_told() -> None:
    assert replay(ToyEnvironment(forgetful=True), EPISODE).first_difference == 0
    executed = EPISODE.executed.copy()
    executed[4] += 0.01
    assert replay(ToyEnvironment(), replace(EPISODE, executed=executed)).first_difference == 5


def test_another_end_differs_even_if_all_joints_are_the_same() -> None:
    assert replay(ToyEnvironment(), replace(EPISODE, outcome="timeout")).first_difference == STEPS
    short = replace(EPISODE, observations=EPISODE.observations[:-1], executed=EPISODE.executed[:-1])
    assert replay(ToyEnvironment(), short).first_difference == STEPS - 1
    longer = [*EPISODE.observations, EPISODE.observations[-1]]
    executed = np.concatenate([EPISODE.executed, EPISODE.executed[-1:]])
    assert replay(ToyEnvironment(), replace(EPISODE, observations=longer, executed=executed)).first_difference == STEPS


class Planning(ToyExpert):
    """Looks when there is a new instruction, and then no more."""

    def reset(self, instruction: str, seed: int) -> None:
        super().reset(instruction, seed)
        self.looks = True

    def act(self, observation: Observation) -> Array:
        self.looks = False
        return super().act(observation)


class Changing(ToyEnvironment):
    """Asks for something else after five steps."""

    def _look(self) -> Observation:
        return replace(super()._look(), instruction="go" if self._steps < 5 else "go on")


@pytest.mark.parametrize(
    ("world", "agent", "seen"), [(ToyEnvironment, Planning, 1), (Changing, Planning, STEPS), (Changing, ToyExpert, 1)]
)
def test_images_are_left_out_only_where_no_one_could_need_them(
    world: type[ToyEnvironment], agent: type[ToyExpert], seen: int
) -> None:
    episode = rollout(world(), agent(), 1, all_images=False)
    assert [bool(observation.rgb) for observation in episode.observations] == [True] * seen + [False] * (STEPS - seen)
