"""Environments of gymnasium as worlds: the same episodes as without gymnasium in between, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import toy
from composing import composed
from gymnasium.error import DependencyNotInstalled
from saved_policies import save_policy

from vla.config import packages
from vla.config.adopt import adopt
from vla.config.build import build
from vla.config.experiment import to_plain
from vla.envs.gym import Task
from vla.rollouts.rollout import rollout
from vla.spec import Environment
from vla.tasks.gymnasium import Gymnasium

VALUES = (
    *("task=gymnasium", "task.package=toy_gym", "task.id=toy/Toy-v0", "task.instruction=observation.instruction"),
    *("task.image_size=[16,16]", "task.images={eye: observation.eye}", "task.action=[x,y,gripper]"),
    *(
        "task.state={observation.state: [east,north]}",
        "task.truth={target: info.truth.target, point: info.truth.point}",
    ),
)


def node(**changes: Any) -> dict[str, Any]:
    return {**to_plain(composed(*VALUES))["task"], **changes}


def make(**changes: Any) -> Any:
    values = node(**changes)
    values.pop("_target_")
    return Gymnasium(**values)


def test_the_spec_and_the_episodes_are_those_of_the_world_within() -> None:
    world: Environment
    world, own = make(), toy.ToyEnvironment()
    assert {**world.spec.to_dict(), "state_units": 0, "units": 0} == {
        **toy.SPEC.to_dict(),
        "state_units": 0,
        "units": 0,
    }
    for seed in (0, 3):
        seen, expected, random = world.reset(seed), own.reset(seed), np.random.default_rng(seed)
        while True:
            assert seen.truth is not None and expected.truth is not None
            np.testing.assert_array_equal(seen.rgb["eye"], expected.rgb["eye"])
            np.testing.assert_array_equal(seen.state, expected.state)
            np.testing.assert_array_equal(seen.truth["target"], expected.truth["target"])
            assert (seen.instruction, world.outcome, world.done) == (expected.instruction, own.outcome, own.done)
            if own.done:
                break
            towards = expected.truth["target"] - expected.state
            action = np.array([*np.clip(towards, -0.05, 0.05), random.uniform()], np.float32)
            seen, expected = world.step(action), own.step(action)
        assert own.outcome == ("success" if seed == 0 else "timeout")
    with pytest.raises(ValueError, match="no episode is running"):
        world.step(np.zeros(3, np.float32))
    with world.blind():
        assert world.reset(1).rgb == {}


def test_rendered_images_are_resized_and_components_numbered() -> None:
    world = make(images={"above": "render"}, image_size=[8, 12], state={"observation.state": None}, action=None)
    assert world.reset(5).rgb["above"].shape == (8, 12, 3)
    assert world.spec.state == ("state_0", "state_1") and world.spec.action == ("action_0", "action_1", "action_2")
    with world.blind():
        assert world.reset(5).rgb == {}


def test_images_are_cropped_as_those_of_demonstrations_are() -> None:
    plain, wide = make().reset(5).rgb["eye"], make(image_size=[8, 16]).reset(5).rgb["eye"]
    np.testing.assert_array_equal(wide, plain[4:12])  # the largest part of 16 by 16 pixels with this aspect ratio


def test_bounds_and_units_are_those_of_the_user_where_told() -> None:
    world = make(low=[-0.5, -0.1, 0.0], high=[0.5, 0.1, 1.0], units={"x": "m", "y": "m"})
    assert world.spec.low == (-0.5, -0.1, 0.0) and world.spec.high == (0.5, 0.1, 1.0)
    assert world.spec.units == ("m", "m", "1") and world.spec.state_units == ("1", "1")
    assert make(low=-2, high=3.0, id="toy/Unbounded-v0").spec.high == (3.0,) * 3
    own = make().spec
    assert own.units == ("1",) * 3 and own.low[0] == -0.05


def test_whole_numbers_are_the_nearest_ones() -> None:
    world = make(id="toy/Whole-v0")
    world.reset(0)
    world.step(np.array([1.7, -1.7, 0.4]))
    assert world._environment.unwrapped.taken.tolist() == [2, -2, 0]


def test_state_entries_with_one_name_are_told_apart_by_their_paths() -> None:
    world = make(state={"observation.state": None, "info.truth.state": None}, id="toy/Twice-v0")
    assert world.spec.state == ("state_0", "state_1", "truth.state_0", "truth.state_1")
    world = make(state={"observation.state": None, "info.state": None}, id="toy/Twice-v0")
    assert world.spec.state == tuple(f"{path}.state_{n}" for path in ("observation", "info") for n in (0, 1))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"id": "toy/Unbounded-v0"}, "have no bounds: set task.low, a number, or one per component"),
        ({"low": [0.0]}, "task.low has 1 numbers, an action has 3 components"),
        ({"units": {"z": "m"}}, "task.units names z, the components are east, north, x, y, gripper"),
        ({"id": "toy/Endless-v0"}, "toy/Endless-v0 does not tell how long an episode lasts: set task.steps"),
        ({"success": "is_success"}, "task.success=is_success must be a path that begins with observation. or info."),
        ({"id": "toy/None-v0"}, "task.id=toy/None-v0 is not registered by toy_gym"),
        ({"id": "toy_gym:toy/Toy-v0"}, "is no environment of task.package=toy_gym"),
        ({"id": "toy/Elsewhere-v0"}, "is no environment of task.package=toy_gym"),
        ({"package": "not_there"}, "task.package=not_there cannot be imported, install it"),
        (
            {"state": {"observation.pose": None}},
            "there is no observation.pose in what the environment returns: instead",
        ),
        ({"state": {"observation.state": ["east"]}}, "observation.state has 2 components, and 1 names: east"),
        (
            {"state": {"observation.state": ["east", "east"]}},
            "task.id=toy/Toy-v0",
        ),
        ({"state": {"observation": None}}, "observation is no array of numbers, but of dict"),
        ({"truth": {"words": "observation.instruction"}}, "observation.instruction is no array of numbers, but of str"),
        (
            {"options": {"seconds_per_stop": 0.1}},
            "toy/Toy-v0 cannot be made with task.options={'seconds_per_stop'",
        ),
        (
            {"id": "toy/Whole-v0", "options": {"level": "wide"}},
            "toy/Whole-v0 cannot be made with task.options={'level': 'wide'}: KeyError 'wide'",
        ),
        ({"images": {"eye": "observation.state"}}, "task.images.eye names no (H, W, 3) image of uint8, but float32"),
    ],
)
def test_what_does_not_fit_is_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        make(**changes)


@pytest.mark.parametrize("path", ["info.truth", "info.truth.point", "observation.instruction"])
def test_success_is_a_flag(path: str) -> None:
    world = make(success=path)
    world.reset(0)
    with pytest.raises(ValueError, match=rf"task\.success={re.escape(path)} must be a flag, and is of "):
        world.step(np.zeros(3, np.float32))


def test_a_world_may_have_tensors() -> None:
    tensors, arrays = (rollout(make(id=f"toy/{kind}-v0"), toy.ToyExpert(), 0) for kind in ("Tensors", "Toy"))
    assert tensors.outcome == arrays.outcome == "success"
    np.testing.assert_array_equal(tensors.executed, arrays.executed)


def test_success_that_is_never_told_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    world = make(success="info.sucess", steps=2, id="toy/Endless-v0")
    for seed in (0, 1):
        world.reset(seed)
        while not world.done:
            world.step(np.zeros(3, np.float32))
        assert world.outcome == "timeout"
    assert caplog.text.count("a whole episode gave no info.sucess, so it counts as failed") == 1


def test_what_the_command_line_names_is_trusted_and_what_a_file_names_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(packages.TRUSTED, "")
    with pytest.raises(ValueError, match=r"task names toy_gym, which is not trusted: add trust=\[toy_gym\]"):
        build(node(), "task")
    arguments = {name: value for name, value in node().items() if name != "_target_"}
    Task("gymnasium", **arguments).close()  # in Python the caller has chosen the package
    packages.trust([], [], ["toy_gym", "???"])
    build(node(), "task").close()
    for name in ("os", "torch", "numpy", None):
        with pytest.raises(ValueError, match=rf"package cannot name {name!r}: give the name by which a package is"):
            packages.trust([], [], [name])
    packages.trust([], [], ["gymnasium"])
    assert not packages.is_trusted("gymnasium.vector.SyncVectorEnv")
    with pytest.raises(ValueError, match=r"task\.id=Pendulum-v1 cannot be played"):  # which draws by pygame
        build(
            node(package="gymnasium", id="Pendulum-v1", images={"above": "render"}, state={"observation": None}), "task"
        )
    packages.trust([], [])
    file = save_policy(tmp_path / "policy", to_plain(composed(*VALUES)))
    with pytest.raises(ValueError, match=r"policy names toy_gym, which is not trusted: add trust=\[toy_gym\]"):
        adopt(composed(f"checkpoint={file}"), [])
    with pytest.raises(ValueError, match="toy_gym, which is not trusted"):
        build(node(), "task")


def test_demonstrations_are_collected_and_replayed_as_in_the_world_within(folder: Path, tmp_path: Path) -> None:
    store = toy.make_store(tmp_path / "gymnasium", make)
    assert {entry.task for entry in store.episodes} == {"toy/Toy-v0"}
    for name in ("rgb_eye.bin", "state.bin", "action.bin", "executed.bin", "truth.bin"):
        assert (store.folder / name).read_bytes() == (folder / name).read_bytes(), name


def test_a_world_whose_library_is_missing_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    missing = Mock(side_effect=DependencyNotInstalled("no pygame"))
    monkeypatch.setattr("toy_gym.Toy.reset", missing)
    with pytest.raises(ValueError, match=r"task\.id=toy/Toy-v0 cannot be played: no pygame"):
        make()
