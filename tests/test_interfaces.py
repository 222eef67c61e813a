"""Tasks through gymnasium and dm_env: their own conformity checks, and the same episodes as everywhere else."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from toy import ToyEnvironment

from vla.config.compose import CONF, compose_task
from vla.envs.dm_env import DmEnvironment, load
from vla.envs.gym import GymEnvironment
from vla.spec import FIRST_SEED, Observation

WORLDS = Path(__file__).parents[1] / "docs/worlds.md"
TASK = "vla.envs:vla/Tabletop-v0"


class Falling(ToyEnvironment):
    """The toy world, in which the first step is a failure that ends the episode."""

    def step(self, action: Any) -> Observation:
        observation = super().step(action)
        self.outcome, self.done = "failure", True
        return observation


def test_a_failure_is_no_time_limit() -> None:
    environment = GymEnvironment(Falling())
    environment.reset(seed=3)
    assert environment.step(np.zeros(3, np.float32))[1:4] == (0.0, True, False)
    adapted = DmEnvironment(Falling())
    adapted.reset(3)
    last = adapted.step(np.zeros(3, np.float32))
    assert last.last() and (last.reward, last.discount) == (0.0, 0.0)


def test_images_are_contiguous_though_a_world_mirrors_its_own() -> None:
    class Mirrored(ToyEnvironment):
        def reset(self, seed: int) -> Observation:
            seen = super().reset(seed)
            return replace(seen, rgb={name: image[::-1] for name, image in seen.rgb.items()})

    seen = GymEnvironment(Mirrored()).reset(seed=3)[0], DmEnvironment(Mirrored()).reset(3).observation
    assert all(each["eye"].flags.c_contiguous for each in seen)


def test_an_observation_stays_what_it_was_when_a_world_reuses_its_arrays() -> None:
    class Reusing(ToyEnvironment):
        kept: Observation | None = None

        def _look(self) -> Observation:
            seen = super()._look()
            self.kept = self.kept or seen
            self.kept.rgb["eye"][:], self.kept.state[:] = seen.rgb["eye"], seen.state
            return self.kept

    action = np.full(3, 0.05, np.float32)
    environment, adapted = GymEnvironment(Reusing()), DmEnvironment(Reusing())
    gym_steps = environment.reset(seed=3)[0], environment.step(action)[0]
    dm_steps = adapted.reset(3).observation, adapted.step(action).observation
    for first, second in (gym_steps, dm_steps):
        assert not np.array_equal(first["state"], second["state"]) and not np.array_equal(first["eye"], second["eye"])


def test_worlds_in_processes_give_instructions_or_an_error() -> None:
    makers = [lambda: GymEnvironment(ToyEnvironment())] * 2
    with pytest.raises(ValueError, match="shared_memory=False"):
        AsyncVectorEnv(makers)
    environment = AsyncVectorEnv(makers, shared_memory=False)
    observation, _ = environment.reset(seed=[3, 4])
    assert all(text.startswith("go to the ") for text in observation["instruction"])
    environment.close()


def test_a_mode_that_draws_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^render_mode='human' is none of the modes"):
        GymEnvironment(ToyEnvironment(), "human")


@pytest.fixture(scope="module")
def lift() -> Iterator[Any]:
    """A small task, made by gymnasium."""
    environment = gymnasium.make(
        TASK, goal="lift", randomize="wide", image_size=(32, 48), time_limit=1.0, render_mode="rgb_array"
    )
    yield environment
    environment.close()


def test_gymnasium_finds_no_fault(lift: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(lift.unwrapped)


def test_a_seed_names_the_same_episode_everywhere(lift: Any) -> None:
    world, actions = lift.unwrapped.environment, np.random.default_rng(0).uniform(-0.02, 0.02, (2, 7))
    for seed in (3, FIRST_SEED + 3):
        seen = [lift.reset(seed=seed), *(lift.step(action) for action in actions)]
        own: list[Observation] = [world.reset(seed), *(world.step(action) for action in actions)]
        assert seen[0][1]["draws"] == world.draws
        for (arrays, *_), observation in zip(seen, own, strict=True):
            assert arrays["instruction"] == observation.instruction
            np.testing.assert_array_equal(arrays["front"], observation.rgb["front"])
            np.testing.assert_array_equal(arrays["wrist"], observation.rgb["wrist"])
            np.testing.assert_array_equal(arrays["state"], observation.state)


def test_without_a_seed_every_episode_is_new_and_none_is_of_evaluation(lift: Any) -> None:
    drawn = [lift.reset(seed=seed)[1]["draws"]["placement"]["blocks"] for seed in (5, None, None)]
    assert drawn[0] != drawn[1] != drawn[2]
    assert lift.reset(seed=5)[1]["draws"]["placement"]["blocks"] == drawn[0]
    assert lift.reset()[1]["draws"]["placement"]["blocks"] == drawn[1]

    class Seeds(ToyEnvironment):
        def reset(self, seed: int) -> Observation:
            assert seed < FIRST_SEED
            return super().reset(seed)

    for _ in range(20):
        GymEnvironment(Seeds()).reset()
        DmEnvironment(Seeds()).reset()


@pytest.mark.parametrize(("seed", "success"), [(0, True), (3, False)])
def test_success_terminates_and_the_time_limit_truncates(seed: int, success: bool) -> None:
    wrapped, world = GymEnvironment(ToyEnvironment(), "rgb_array"), ToyEnvironment()
    timed = DmEnvironment(ToyEnvironment())
    seen, _ = wrapped.reset(seed=seed)
    observation, step = world.reset(seed), timed.reset(seed)
    rewards: list[float] = []
    terminated = truncated = False
    info: dict[str, Any] = {}
    action = np.zeros(3)
    while not (terminated or truncated):
        assert observation.truth is not None
        action = np.append(np.clip(observation.truth["target"] - observation.truth["point"], -0.05, 0.05), 1.0)
        observation, step = world.step(action), timed.step(action)
        seen, reward, terminated, truncated, info = wrapped.step(action)
        rewards.append(reward)
        assert step.last() == (terminated or truncated) and step.reward == reward
    assert (terminated, truncated) == (success, not success)
    assert rewards == [0.0] * (len(rewards) - 1) + [float(success)]
    assert step.discount == float(not success)
    assert info["outcome"] == world.outcome
    np.testing.assert_array_equal(wrapped.render(), seen["eye"])
    assert timed.step(action).first()


def test_a_task_is_composed_as_on_the_command_line_and_hydra_is_left_as_it_was() -> None:
    overrides = {"goal": "lift", "randomize": "wide", "randomize/light": "hard", "goal.height": 0.1}
    with initialize_config_dir(str(CONF), version_base="1.3"):
        before = GlobalHydra.instance().hydra
        node = compose_task("tabletop", image_size=(64, 48), **overrides)
        assert GlobalHydra.instance().hydra is before
        said = ["task/goal=lift", "task/randomize=wide", "task/randomize/light=hard"]
        assert node == compose("config", [*said, "task.goal.height=0.1", "task.image_size=[64,48]"]).task
        more = {"goal.language.held_out_colours": ["green"], "goal.language.words": {"lift": ["take"]}}
        said = ["task.goal.language.held_out_colours=[green]", "task.goal.language.words={lift: [take]}"]
        assert compose_task("tabletop", goal="lift", **more) == compose("config", ["task/goal=lift", *said]).task
    assert not GlobalHydra.instance().is_initialized()
    with pytest.raises(Exception, match="pick_place"):
        compose_task("tabletop", goal="lft")
    with pytest.raises(Exception, match="image_sise"):
        compose_task("tabletop", image_sise=(64, 64))
    assert not GlobalHydra.instance().is_initialized()


class TestDmEnv(test_utils.EnvironmentTestMixin, absltest.TestCase):
    """The conformity tests of dm_env, with episodes that end after three steps."""

    tabletop: ClassVar[DmEnvironment]

    @classmethod
    def setUpClass(cls) -> None:
        cls.tabletop = load("tabletop", goal="lift", image_size=(16, 16), time_limit=0.3)

    @classmethod
    def tearDownClass(cls) -> None:
        cls.tabletop.close()

    def tearDown(self) -> None:
        """Nothing is closed: the tests share one simulator."""

    def make_object_under_test(self) -> DmEnvironment:
        return DmEnvironment(self.tabletop.environment, random_state=0)

    def test_every_reset_starts_another_episode(self) -> None:
        """Environments with equal random states go through the same ones."""
        one, other = self.make_object_under_test(), self.make_object_under_test()
        states = [one.reset().observation["state"].tobytes() for _ in range(3)]
        assert len(set(states)) == 3
        assert [other.reset().observation["state"].tobytes() for _ in range(3)] == states


def test_the_page_runs() -> None:
    first, second = re.findall(r"```python\n(.*?)```", WORLDS.read_text(encoding="utf-8"), re.DOTALL)
    exec(first, {})
    exec(second, {})
