"""Observations under the names of LeRobot, and what the distributions in `plugins` promise to it."""

from __future__ import annotations

import ast
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
from composing import composed
from toy import ARM_SPEC

from vla.config.experiment import to_plain
from vla.data.formats import lerobot_layout as layout
from vla.envs import lerobot
from vla.envs.lerobot import LeRobotEnvironment, arrays, observations
from vla.spec import FIRST_SEED

ROOT = Path(__file__).parents[1]
PLUGINS = {path.parent.name: path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml")}
KEYS = {"is_success", "_is_success"}  # of `info`
SMALL: dict[str, Any] = {"goal": "lift", "image_size": [32, 48], "time_limit": 0.3}


def test_an_episode_is_that_of_the_world_under_the_names_of_lerobot() -> None:
    world = LeRobotEnvironment("tabletop", 50, SMALL)
    vector = gymnasium.vector.SyncVectorEnv([lambda: world])
    seen, action, steps = [vector.reset(seed=[FIRST_SEED])[0]], np.full((1, 7), 0.01, np.float32), 0
    while True:
        observation, _, terminated, truncated, info = vector.step(action)
        seen, steps = [*seen, observation], steps + 1
        assert vector.call("task") == ("lift",) and info["is_success"].tolist() == [False] and {*info} <= KEYS
        if terminated[0] or truncated[0]:
            break
    (said,) = vector.call("task_description")
    assert steps == 3 and truncated[0] and vector.call("_max_episode_steps") == (50,)
    assert vector.metadata["render_fps"] == 10
    bounds = cast(gymnasium.spaces.Box, vector.single_action_space)
    np.testing.assert_allclose(bounds.low, [-0.04] * 3 + [-0.25] * 3 + [0], rtol=1e-6)
    np.testing.assert_allclose(bounds.high, [0.04] * 3 + [0.25] * 3 + [1], rtol=1e-6)
    inner = world.environment
    own = [inner.reset(FIRST_SEED), *(inner.step(action[0]) for _ in range(3))]
    for renamed, expected in zip(seen, own, strict=True):
        assert {*renamed} == {"pixels", "agent_pos", "velocities"} and said == expected.instruction
        for camera in ("front", "wrist"):
            np.testing.assert_array_equal(renamed["pixels"][camera][0], expected.rgb[camera])
        np.testing.assert_array_equal(renamed["agent_pos"][0], expected.state[[*range(7), 14]])
        np.testing.assert_array_equal(renamed["velocities"][0], expected.state[7:14])
    vector.close()


def test_no_episode_of_lerobot_is_one_of_training() -> None:
    """Its default seed is 1000, its environments are reset without one when an episode ends, and ours keep theirs."""
    world = LeRobotEnvironment("tabletop", 50, SMALL)
    played, really = list[int](), world.environment.reset
    world.environment.reset = lambda seed: (played.append(seed), really(seed))[1]  # type: ignore[method-assign]
    for seed in (1000, FIRST_SEED + 7, None, None):
        world.reset(seed=seed)
    world.close()
    assert played[:2] == [FIRST_SEED + 1000, FIRST_SEED + 7]
    assert played[2] != played[3] and all(seed >= FIRST_SEED for seed in played)


def test_without_seeds_other_episodes_follow_for_long() -> None:
    world, played = LeRobotEnvironment("tabletop", 50, SMALL), list[int]()
    shown = world.environment.reset(FIRST_SEED)
    world.environment.reset = lambda seed: (played.append(seed), shown)[1]  # type: ignore[method-assign]
    for seed in (1000, *[None] * 999):
        world.reset(seed=seed)
    first = played.copy()
    world.reset(seed=1000)
    world.reset()
    world.close()
    assert len({*first}) > 990 and played[1000:] == first[:2]


def test_names_and_back_is_the_same_observation() -> None:
    random, spec = np.random.default_rng(0), ARM_SPEC
    given = [spec.random_observation(random) for _ in range(2)]
    rows = [arrays(observation, spec) for observation in given]
    batch = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    assert all(value.dtype == np.float32 and value.flags.c_contiguous for value in batch.values())
    back = observations({**batch, "task": [each.instruction for each in given], "index": np.arange(2)}, spec)
    for one, other in zip(given, back, strict=True):
        np.testing.assert_array_equal(one.state, other.state)
        for camera in spec.cameras:
            np.testing.assert_array_equal(one.rgb[camera], other.rgb[camera])
        assert one.instruction == other.instruction


def test_what_is_missing_or_of_another_shape_is_named() -> None:
    observation = ARM_SPEC.random_observation(np.random.default_rng(0))
    batch: dict[str, Any] = {key: value[None] for key, value in arrays(observation, ARM_SPEC).items()} | {"task": [""]}
    without = {key: value for key, value in batch.items() if key != lerobot.RATES}
    with pytest.raises(
        ValueError, match=r"the policy needs observation\.velocities, but the batch has observation\.images"
    ):
        observations(without, ARM_SPEC)
    with pytest.raises(ValueError, match=r"observation\.state must be \(1, 8\): joint1, .*, gripper; it is \(1, 6\)"):
        observations({**batch, lerobot.STATE: batch[lerobot.STATE][:, :6]}, ARM_SPEC)


def test_the_names_are_those_of_exported_datasets() -> None:
    assert lerobot.STATE == layout.STATE and f"observation.{layout.RATES}" == lerobot.RATES
    assert lerobot.IMAGES == "observation.images."


def test_lerobot_finds_the_plugins_by_its_rules() -> None:
    """It imports distributions by the beginning of their name, and the parts of a policy by the names of modules."""
    assert {*PLUGINS} == {"lerobot_env_vla", "lerobot_policy_vla"}
    for name, folder in PLUGINS.items():
        project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        assert project["name"] == name and "vla" in project["dependencies"]
    policy = PLUGINS["lerobot_policy_vla"] / "lerobot_policy_vla"
    for module, name in (
        ("configuration_vla", "VlaConfig"),
        ("modeling_vla", "VlaPolicy"),
        ("processor_vla", "make_vla_pre_post_processors"),
    ):
        tree = ast.parse((policy / f"{module}.py").read_text(encoding="utf-8"))
        assert name in [node.name for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))]


def test_the_commands_of_the_page_compose() -> None:
    page = (ROOT / "docs/lerobot.md").read_text(encoding="utf-8")
    options = PLUGINS["lerobot_policy_vla"] / "lerobot_policy_vla/conf"
    export, evaluate = re.findall(r"^python -m vla\.run (.*)$", page.replace("\\\n", ""), re.MULTILINE)
    assert composed(*shlex.split(export)).export.folder == "DATASET"
    agent = to_plain(composed(*shlex.split(evaluate), f"hydra.searchpath=[file://{options}]"))["agent"]
    target = agent.pop("_target_")
    module, _, name = target.rpartition(".")
    tree = ast.parse((PLUGINS["lerobot_policy_vla"] / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
    (made,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    (init,) = (node for node in made.body if isinstance(node, ast.FunctionDef) and node.name == "__init__")
    assert [argument.arg for argument in init.args.args] == ["self", *agent]
