"""Worlds side by side: every episode is what it is alone, bit for bit, and an error costs one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from fake_batch import as_policy, make_act, make_bc, make_denoising, make_rt1
from toy import Telling, ToyEnvironment, ToyExpert, ToyInTurn

from vla.models.diffusion import Diffusion
from vla.models.flow import Flow
from vla.models.model import Model
from vla.policy import Policy
from vla.rollouts.evaluate import evaluate
from vla.rollouts.rollout import rollout
from vla.rollouts.worlds import Stage, as_agents, play
from vla.spec import FIRST_SEED, Array, Episode, Observation

MODELS: dict[str, Callable[[], Model]] = {
    "bc": make_bc,
    "rt1": make_rt1,
    "act": partial(make_act, execute=2),
    "diffusion": partial(make_denoising, Diffusion),
    "flow": partial(make_denoising, Flow),
}


def worlds(lanes: int, make: Callable[[], ToyEnvironment] = ToyEnvironment) -> list[Stage]:
    return [Stage(make()) for _ in range(lanes)]


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())
@pytest.mark.parametrize("rows", [1, 2, 4])
def test_episodes_side_by_side_are_those_that_are_played_alone(make: Callable[[], Model], rows: int) -> None:
    policy = as_policy(make(), lanes=rows)
    alone = {seed: rollout(Telling(), policy, seed).executed for seed in (2, 3, 4, 5, 9)}
    for lanes, seeds in ((1, [9, 3]), (2, [2, 3, 4, 5, 9]), (4, [9, 5, 4, 3, 2])):
        played = dict(play(worlds(lanes, Telling), policy, seeds, all_images=False))
        assert sorted(played) == sorted(seeds)
        for seed, episode in played.items():
            np.testing.assert_array_equal(episode.executed, alone[seed])


def test_lanes_are_filled_again_as_their_episodes_end() -> None:
    passes: list[int] = []

    class Counting(Policy):
        def act(self, observations: object, lanes: object = None) -> Array:
            passes.append(len(lanes))  # type: ignore[arg-type]
            return super().act(observations, lanes)  # type: ignore[call-overload,no-any-return]

    policy = as_policy(make_bc(), lanes=2)
    policy.__class__ = Counting
    steps = [len(episode.executed) for _, episode in play(worlds(2), policy, range(6))]
    assert steps == [40] * 6 and passes == [2] * 120


def test_an_error_of_a_world_or_of_an_observation_ends_one_episode() -> None:
    class Breaking(ToyEnvironment):
        def step(self, action: Array) -> Observation:
            seen = super().step(action)
            if self._steps == 5 and self._seed == 1:
                raise RuntimeError("it fell off")
            return replace(seen, state=seen.state[:1]) if self._steps == 7 and self._seed == 2 else seen

    policy = as_policy(make_rt1(), lanes=4)
    alone = {seed: rollout(ToyEnvironment(), policy, seed).executed for seed in (0, 3)}
    played = dict(play(worlds(4, Breaking), policy, range(4)))
    assert isinstance(played[1], RuntimeError) and "the state must hold" in str(played[2])
    for seed, executed in alone.items():
        np.testing.assert_array_equal(played[seed].executed, executed)


def test_where_a_new_instruction_needs_an_image_only_its_episode_is_run_again() -> None:
    class Changing(ToyEnvironment):
        def _look(self) -> Observation:
            new = self._steps >= 5 and self._seed == 2
            return replace(super()._look(), instruction="go on" if new else "go")

    policy = as_policy(make_act(execute=4), lanes=2)
    played: dict[int, Episode] = dict(play(worlds(2, Changing), policy, [1, 2], all_images=False))
    assert [bool(seen.rgb) for seen in played[1].observations] == [True, False, False, False] * 10
    assert all(seen.rgb for seen in played[2].observations)
    np.testing.assert_array_equal(played[2].executed, rollout(Changing(), policy, 2).executed)


def test_an_agent_of_one_world_plays_in_one() -> None:
    expert = ToyExpert()
    played = dict(play(worlds(1), as_agents(expert), [4, 1]))
    assert [*played] == [4, 1]
    for seed, episode in played.items():
        np.testing.assert_array_equal(episode.executed, rollout(ToyEnvironment(), expert, seed).executed)
    with pytest.raises(ValueError, match=r"ToyInTurn has no `info`: set self\.info"):
        as_agents(ToyInTurn())  # type: ignore[arg-type]


def test_an_evaluation_in_lanes_reports_the_same() -> None:
    policy = as_policy(make_bc(), lanes=2)
    seeds = range(FIRST_SEED, FIRST_SEED + 7)
    reports = [evaluate(Telling, lambda world: policy, None, seeds, lanes=lanes) for lanes in (1, 2, 3)]
    assert reports[0] == reports[1] == reports[2] and not reports[0].errors


def test_a_world_may_reuse_its_arrays_and_have_those_of_another_library() -> None:
    class Reusing(ToyEnvironment):
        tool = np.zeros(3)

        def _look(self) -> Observation:
            seen = super()._look()
            self.tool[:2] = self._point
            images: dict[str, Any] = {name: torch.from_numpy(image) for name, image in seen.rgb.items()}
            return replace(seen, rgb=images, state=torch.from_numpy(seen.state))  # type: ignore[arg-type]

    policy = as_policy(make_bc())
    episode, expected = (rollout(make(), policy, 4) for make in (Reusing, ToyEnvironment))
    np.testing.assert_array_equal(episode.executed, expected.executed)
    assert episode.tool is not None
    states = [seen.state for seen in episode.observations]
    np.testing.assert_array_equal(episode.tool[:-1, :2].astype(np.float32), states)
