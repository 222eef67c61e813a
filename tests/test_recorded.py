"""A dataset of any robot is imported, learned from and evaluated without a simulator, and moves a robot's joints."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import composing
import numpy as np
import pyarrow as pa
import pytest
from arm import NO_FINGERS, ROBOT, SAFETY
from command_line import SMALL, here
from exporting import exporter
from fake_batch import as_policy, make_bc
from finished_runs import compared
from lerobot_files import ROWS, column, info
from test_control_loop import World
from test_server import serving

from vla.config.build import build
from vla.config.experiment import to_plain
from vla.data.datamodule import is_held_out
from vla.data.derivation import derive_store
from vla.data.episodes import EpisodeStore
from vla.data.formats.imported_demonstrations import action_bounds, log_clipped
from vla.data.verification import episode_of
from vla.deploy.client_observation import Keys
from vla.deploy.control_loop import ControlLoop
from vla.io.images import resize
from vla.jobs.open_loop import _measure
from vla.models.policy_folder import read_policy
from vla.reports.open_loop import components, errors_table
from vla.robots.controllers import controller_for
from vla.rollouts.open_loop import open_loop
from vla.rollouts.statistics import mean_interval
from vla.spec import Episode, Observation, RobotModel, Spec
from vla.tasks.recorded import Recorded

NAMES = tuple(f"joint{number}.pos" for number in range(1, 4))
SPEC = Spec(
    cameras=("top", "hand"),
    image_size=(24, 32),
    state=NAMES,
    state_units=("deg",) * 3,
    action=NAMES,
    units=("deg",) * 3,
    low=(-90.0,) * 3,
    high=(90.0,) * 3,
    control_hz=30.0,
)
STEPS, EPISODES = 12, 8
TINY = ("model.width=16", "model.text_width=8", "model.keypoints=4")
TRAINING = [option for option in SMALL if not option.startswith(("task.shadows", "task.time", "collect", "task.image"))]


def episode(seed: int) -> Episode:
    """Three joints that move at a constant speed; the brightness of the images tells the first one."""
    random = np.random.default_rng(seed)
    actions = (random.uniform(-30, 30, 3) + np.arange(1, STEPS + 1)[:, None] * random.uniform(-2, 2, 3)).astype("f4")
    seen = [
        Observation({name: np.full((24, 32, 3), 120 + at[0], np.uint8) for name in SPEC.cameras}, at - 1, "move")
        for at in actions
    ]
    return Episode(seed, "move", "move", "success", frozenset(), {}, seen, actions, actions)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LeRobot dataset of a robot that nobody here knows."""
    return exported(tmp_path_factory.mktemp("recorded"), range(EPISODES))


def exported(folder: Path, seeds: range) -> Path:
    store = EpisodeStore.create_or_open(folder / "store", SPEC, {})
    with store.writing():
        for seed in seeds:
            store.append(episode(seed))
    made = Path(exporter("lerobot", folder / "dataset", "export.crf=5").export(store))
    (made / "meta/checksums.json").unlink()
    return made


def composed(dataset: Path, *overrides: str) -> Any:
    return to_plain(composing.composed("task=recorded", f"expert.folder={dataset}", *overrides))


def test_the_spec_is_the_datasets(dataset: Path) -> None:
    config = composed(dataset, "task.units=deg", "task.joints=all")
    spec = build(config["task"], "task").spec
    recorded = np.concatenate([episode(seed).actions for seed in range(EPISODES)])
    assert spec == replace(
        SPEC,
        image_size=(96, 128),
        low=tuple(recorded.min(0).tolist()),
        high=tuple(recorded.max(0).tolist()),
        robot=RobotModel(NAMES, ""),
    )
    assert config["collect"]["episodes"] == EPISODES and config["validate"]["episodes"] == 0


def test_parts_of_a_dataset_are_chosen_by_name(dataset: Path) -> None:
    chosen = ["joint3.pos", "joint1.pos"]
    config = composed(
        dataset,
        "expert.images={eye: observation.images.hand}",
        "expert.every=5",
        f"task.action={json.dumps(chosen)}",
        "task.image_size=[12,12]",
    )
    spec = build(config["task"], "task").spec
    assert (spec.cameras, spec.control_hz, list(spec.action), len(spec.low)) == (("eye",), 6.0, chosen, 2)
    found, there = build(config["expert"], "expert", spec=spec).episode(1), episode(1)
    # Frames 0, 5 and 10, each with the last action before the next one.
    np.testing.assert_array_equal(found.actions, there.actions[[4, 9, 11]][:, [2, 0]])
    np.testing.assert_array_equal([seen.state for seen in found.observations], (there.actions - 1)[[0, 5, 10]])
    for seen, original in zip(found.observations, there.observations[::5], strict=True):
        expected = resize(original.rgb["hand"], (12, 12))
        assert seen.rgb["eye"].shape == (12, 12, 3)
        assert np.abs(seen.rgb["eye"].astype(int) - expected).max() <= 4


def renamed(dataset: Path, folder: Path, names: Any) -> Path:
    """A copy of the dataset whose action has other names."""
    copy = Path(shutil.copytree(dataset, folder))
    info(lambda content: content["features"]["action"].update(names=names))(copy)
    return copy


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["joint", "joint", "gripper"], ("action.joint_0", "action.joint_1", "action.gripper_2")),
        ({"motors": ["a", "b", "c"]}, ("a", "b", "c")),
        ({"left": ["a", "b"], "right": ["c"]}, ("a", "b", "c")),
        ({"left": ["waist", "elbow"], "right": ["waist"]}, ("left_waist", "left_elbow", "right_waist")),
        ({"b": 1, "a": 0, "c": 2}, ("a", "b", "c")),
        ({"left": [2], "right": [1]}, ("action_0", "action_1", "action_2")),
        (None, ("action_0", "action_1", "action_2")),
    ],
)
def test_names_may_be_grouped_repeated_or_none(
    dataset: Path, tmp_path: Path, names: Any, expected: tuple[str, ...]
) -> None:
    copy = renamed(dataset, tmp_path / "dataset", names)
    assert build(composed(copy)["task"], "task").spec.action == expected


def test_unnamed_components_are_chosen_by_their_numbers(dataset: Path, tmp_path: Path) -> None:
    copy = renamed(dataset, tmp_path / "dataset", None)
    config = composed(copy, "task.action=[action_2,action_0,action_1]", "task.image_size=[12,12]")
    spec = build(config["task"], "task").spec
    found = build(config["expert"], "expert", spec=spec).episode(1)
    np.testing.assert_array_equal(found.actions, episode(1).actions[:, [2, 0, 1]])


def test_another_recording_is_not_taken_for_the_stored_one(dataset: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(dataset, tmp_path / "dataset"))
    bounds = ("task.low=[-99,-99,-99]", "task.high=[99,99,99]", "task.image_size=[12,12]")
    import_it = ("task=recorded", "expert.folder=dataset", *bounds, "job=collect", "collect.folder=store", "output=run")
    assert (
        "recorded episodes: set collect.episodes=" in here(tmp_path, *import_it, "collect.episodes=99", ok=False).stderr
    )
    assert not (tmp_path / "store").exists()  # which would block what is asked for next
    here(tmp_path, *import_it)
    column(ROWS, "action", lambda table: pa.array((np.array(table["action"].to_pylist(), "f4") + 1).tolist()))(copy)
    assert "store differs from the recording, first in episode 0" in here(tmp_path, *import_it, ok=False).stderr


def test_a_repaired_import_goes_on(dataset: Path, tmp_path: Path) -> None:
    config = composed(dataset, "task.image_size=[12,12]")
    spec = build(config["task"], "task").spec
    recorded = build(config["expert"], "expert", spec=spec)
    store = EpisodeStore.create_or_open(tmp_path / "store", spec, {})
    with store.writing():
        store.append(recorded.episode(0))
        store.fail(replace(recorded.episode(1), outcome="damaged"))
    assert recorded.fill(store, EPISODES - 1) == EPISODES - 2
    assert [entry.seed for entry in store.episodes] == [0, *range(2, EPISODES)]
    with pytest.raises(ValueError, match=rf"only {EPISODES - 1} whole episodes"):
        recorded.fill(EpisodeStore(tmp_path / "store"), EPISODES)
    other = EpisodeStore.create_or_open(tmp_path / "other", spec, {"expert": "another"})
    with other.writing():
        other.append(replace(recorded.episode(1), seed=0))
    for name, sources in {"chosen": [EpisodeStore(tmp_path / "store")], "merged": [other, store]}.items():
        derive_store(sources, tmp_path / name, {"seed": 0})
        with pytest.raises(ValueError, match=rf"cannot grow: set collect\.episodes={len(sources)}"):
            recorded.fill(EpisodeStore(tmp_path / name), EPISODES - 1)


def test_outliers_do_not_widen_the_bounds_and_rare_events_do() -> None:
    moving = np.append(np.linspace(-1, 1, 1000), 30.0)
    low, high = action_bounds(moving)
    assert low == -1 and 1 < high < 3
    assert action_bounds(np.append(np.zeros(1000), 1.0)) == (0.0, 1.0)  # a gripper that closes once
    noisy = np.random.default_rng(0).uniform(-0.001, 0.001, 10000)
    noisy[::500] = 1.0  # one that closes every now and then
    assert action_bounds(noisy)[1] == 1.0
    noisy[::500], noisy[0] = 0.0, 1e6  # a glitch
    assert action_bounds(noisy)[1] < 0.01
    low, high = action_bounds(np.full(10, 5.0))
    assert low < 5 < high


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["expert.folder=nowhere"], "error: there is no LeRobot dataset in nowhere"),
        (["task.action=[elbow]"], r"error: task.action names elbow: the recording has only joint1.pos"),
        (["task.units={elbow: rad}"], "error: task.units names elbow, the components are joint1.pos"),
        (["agent=remote", "agent.images.top=top"], "; +agent.images.top=VALUE adds it"),
        (["validate.episodes=3"], "validate.episodes=3: nothing can be played in a recording"),
        (["job=evaluate", "evaluate.against=nowhere"], "need a success rate, which recordings lack: omit them"),
        (["job=preview"], "the task has no simulator, only recordings, so nothing can be played in it"),
    ],
)
def test_what_a_recording_cannot_do_is_said(dataset: Path, tmp_path: Path, overrides: list[str], says: str) -> None:
    done = here(tmp_path, "task=recorded", f"expert.folder={dataset}", "job=train", *overrides, ok=False)
    assert says in done.stderr


def test_names_out_of_a_recording_are_no_references(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ATTACK_SECRET", "hunter2secret")
    copy = renamed(dataset, tmp_path / "dataset", ["a", "${oc.env:ATTACK_SECRET}", "c"])
    done = here(tmp_path, "task=recorded", f"expert.folder={copy}", "job=collect", "output=run", ok=False)
    assert "the recording holds the reference '${oc.env:ATTACK_SECRET}'" in done.stderr
    assert "hunter2secret" not in done.stderr and not (tmp_path / "outputs/episodes").exists()


def test_an_expert_that_acts_has_no_recording(tmp_path: Path) -> None:
    done = here(tmp_path, "task=recorded", "expert=waypoint", ok=False)
    assert done.stderr.startswith(
        "error: task=recorded needs recorded demonstrations: expert=lerobot expert.folder=DIR"
    )


def small(dataset: Path) -> tuple[str, ...]:
    """Arguments of the command line that choose the recording, in its own size."""
    return ("task=recorded", f"expert.folder={dataset}", "task.image_size=[24,32]")


def test_a_policy_is_trained_and_its_errors_measured_without_a_simulator(dataset: Path, tmp_path: Path) -> None:
    here(tmp_path, *small(dataset), "job=collect", "collect.folder=further", "output=collect")
    recording, checkpoint = (*small(dataset), "collect.more=[further]"), tmp_path / "run"
    done = here(tmp_path, *recording, *TRAINING, *TINY, "hydra.run.dir=run", "output=run")
    errors = json.loads((tmp_path / "run/errors.json").read_text())
    assert errors["seeds"] == [seed for seed in range(EPISODES) if is_held_out(seed, 0.2)]  # of the recording alone
    assert [each["name"] for each in errors["components"]] == list(NAMES) and "success" not in errors
    assert all(each["ci_low"] <= each["error"] <= each["ci_high"] for each in errors["components"])
    assert "not a success rate" in done.stdout and "success" not in done.stdout.replace("not a success rate", "")
    page = (tmp_path / "run/report.html").read_text()
    assert "Mean absolute errors on 2 held-out episodes" in page and "joint2.pos" in page and "success:" not in page
    assert "${" not in page and str(dataset) in page
    assert list(read_policy(checkpoint).spec.action) == list(NAMES)
    again = ("job=evaluate", f"checkpoint={checkpoint}", "hydra.run.dir=again", "output=again")
    here(tmp_path, *again, *recording)
    repeated = json.loads((tmp_path / "again/errors.json").read_text())
    assert repeated["seeds"] == errors["seeds"] and repeated["components"] == errors["components"]
    assert "learner.lr" not in compared([tmp_path / "run", tmp_path / "again"], tmp_path).read_text()
    forgot = here(tmp_path, *again, "task=recorded", f"expert.folder={dataset}", ok=False)
    assert "was trained with task.image_size=[24, 32], not [96, 128], and only images of that size" in forgot.stderr
    (kept,) = tmp_path.glob("outputs/episodes/*")  # both found it, and the third imported nothing
    shutil.rmtree(kept)
    assert "name its folder with expert=lerobot expert.folder=DIR" in here(tmp_path, *again, ok=False).stderr
    fewer = here(tmp_path, *again, *small(dataset), "collect.episodes=6", ok=False)
    assert "was trained on other episodes than the 6" in fewer.stderr


def test_a_policy_of_another_size_of_images_is_trained_further_and_evaluated(dataset: Path, tmp_path: Path) -> None:
    options = "job=collect collect.folder=further collect.episodes=2 task.image_size=[12,20] output=collect"
    here(tmp_path, *small(dataset), *options.split())
    here(tmp_path, *small(dataset), *TRAINING, *TINY, "job=train", "hydra.run.dir=run", "output=run")
    recording = (*small(dataset), "task.image_size=[18,18]", "collect.more=[further]")
    here(tmp_path, *recording, *TRAINING, "pretrained=run", "output=second", "hydra.run.dir=second")
    assert read_policy(tmp_path / "second").spec.image_size == (24, 32)
    errors = json.loads((tmp_path / "second/errors.json").read_text())
    assert errors["seeds"] == [seed for seed in range(EPISODES) if is_held_out(seed, 0.2)]


def test_a_policy_keeps_its_bounds_when_it_is_trained_further_on_another_recording(
    dataset: Path, tmp_path: Path
) -> None:
    here(tmp_path, *small(dataset), *TRAINING, *TINY, "job=train", "hydra.run.dir=run", "output=run")
    other = small(exported(tmp_path / "other", range(3)))
    first, second = (
        build(to_plain(composing.composed(*part))["task"], "task").spec for part in (small(dataset), other)
    )
    assert first.low != second.low and first.high != second.high
    options = (*TRAINING, "job=train", "pretrained=run", "output=second", "hydra.run.dir=second")
    here(tmp_path, *other, *options)
    policy = read_policy(tmp_path / "second")
    assert policy.spec.high == first.high
    told = here(tmp_path, *other, *options, f"task.high={list(second.high)}", "output=third", ok=False)
    assert "high" in told.stderr and "the policy" in told.stderr


def test_a_training_on_all_episodes_ends_with_success_and_is_complete(dataset: Path, tmp_path: Path) -> None:
    recording = (*small(dataset), "data.validation_fraction=0")
    run = ("hydra.run.dir=outputs/runs/all", "output=outputs/runs/all")
    done = here(tmp_path, *TRAINING, *recording, *TINY, *run)
    said = "data.validation_fraction=0 trains on all episodes and leaves none to evaluate the policy on"
    assert 0 <= done.stdout.find(said) < done.stdout.find("importing") < done.stdout.find("trained 4 steps")
    checkpoint = tmp_path / "outputs/runs/all/policy"
    assert checkpoint.is_dir() and not (tmp_path / "outputs/runs/all/errors.json").exists()
    (kept,) = tmp_path.glob("outputs/episodes/*")
    shutil.rmtree(kept)
    for whose in ((f"checkpoint={checkpoint}",), ("agent=remote", "agent.url=ws://127.0.0.1:1")):
        refused = here(tmp_path, *recording, *whose, "output=again", ok=False)
        assert "data.validation_fraction=0: " in refused.stderr and "train with a larger fraction" in refused.stderr
        assert not kept.exists() and not (tmp_path / "again").exists()


def test_a_served_policy_is_compared_with_the_episodes_that_a_training_holds_out(dataset: Path, tmp_path: Path) -> None:
    spec = build(composed(dataset, "task.image_size=[24,32]")["task"], "task").spec
    policy = as_policy(make_bc(spec=spec), spec=spec)
    cameras = {camera: f"observation.images.{camera}" for camera in spec.cameras}
    images = [f"+agent.images.{camera}={key}" for camera, key in cameras.items()]
    with serving(policy, keys=Keys(cameras, ["observation/state"], "prompt")) as url:
        asked = ("agent=remote", f"agent.url={url}", *images, "output=theirs")
        said = here(tmp_path, *small(dataset), *asked).stdout
        assert "remote" in (tmp_path / "theirs/report.html").read_text() and "not a success rate" in said
        errors = json.loads((tmp_path / "theirs/errors.json").read_text())
        assert errors["checkpoint"] is None and errors["model"] == "remote"
    store = EpisodeStore(next(tmp_path.glob("outputs/episodes/*")))
    unseen = [entry for entry in store.episodes if is_held_out(entry.seed, 0.2)]
    shown = [episode_of(store, entry) for entry in unseen]
    expected = open_loop(as_policy(policy.model, spec=spec), spec, shown, np.zeros(3))
    assert errors["seeds"] == [entry.seed for entry in unseen]
    np.testing.assert_allclose([each["error"] for each in errors["components"]], expected.errors.mean(0), rtol=1e-6)
    with pytest.raises(ValueError, match=r"agent\._target_ must name a class of kind Agent"):
        composing.check(composing.composed(*small(dataset), "agent=expert"))


def test_imported_episodes_are_exported_as_others_are(dataset: Path, tmp_path: Path) -> None:
    folders = ("collect.folder=store", "export.folder=new", "output=run")
    here(tmp_path, "job=export", "export=lerobot", *small(dataset), *folders, "cluster.workers=1")
    again = build(composed(tmp_path / "new", "task.image_size=[24,32]")["task"], "task").spec
    assert (again.action, again.state, again.control_hz) == (NAMES, NAMES, 30.0)


class Behind:
    """An agent that acts one degree less than was recorded, and two in the second episode."""

    def __init__(self) -> None:
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        self._seed = seed

    def act(self, observation: Observation) -> np.ndarray:
        return observation.state + 1 - (1 + self._seed)


def test_errors_are_means_over_recordings_with_an_interval() -> None:
    result = open_loop(Behind(), SPEC, [episode(0), episode(1)], np.zeros(3))
    np.testing.assert_allclose(result.errors, [[1] * 3, [2] * 3], rtol=1e-5)
    # 1.5 +- t(0.975, 1) * 0.7071 / sqrt(2), with t(0.975, 1) = 12.7062; no error is below zero
    for each in components(result):
        assert each.error == pytest.approx(1.5) and each.ci_low == 0 and each.ci_high == pytest.approx(1.5 + 6.3531)
    assert components(open_loop(Behind(), SPEC, [episode(0)], np.zeros(3)))[0].ci_high is None
    low, high = mean_interval(np.array([[1.0], [2.0], [3.0]]))  # 2 +- t(0.975, 2) / sqrt(3), t = 4.3027
    np.testing.assert_allclose([low[0], high[0]], [0.0, 2 + 4.3027 / np.sqrt(3)], rtol=1e-4)
    # Three episodes of one recording, with errors of 1, 2 and 3, and one of another, with 4: two means, 2 and 4.
    parts = [replace(episode(seed), draws={"recorded": {"episode": seed // 3}}) for seed in range(4)]
    split = open_loop(Behind(), SPEC, parts, np.zeros(3))
    np.testing.assert_allclose(split.mean, [3] * 3, rtol=1e-5)
    np.testing.assert_allclose(split.interval[1], [3 + 12.7062] * 3, rtol=1e-4)
    assert split.relative == pytest.approx(float((split.mean / split.constant_errors).mean()))


def test_the_share_of_clipped_actions_is_of_whole_actions(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "vla"):
        log_clipped(np.array([[91.0, 0.0, 0.0], [0.0, 90.0, 0.0]], np.float32), SPEC)
    assert caplog.messages == ["50 % of the actions are clipped to the bounds of the task"]


def test_the_constant_action_is_the_mean_of_all_episodes_of_a_training(tmp_path: Path) -> None:
    stores = [EpisodeStore.create_or_open(tmp_path / name, SPEC, {}) for name in ("first", "more")]
    for number, store in enumerate(stores):
        with store.writing():
            for seed in range(4 * number, 4 * number + 4):
                store.append(episode(seed))
    nodes: Any = SimpleNamespace(evaluate=SimpleNamespace(episodes=9), collect=SimpleNamespace(more=[stores[1].folder]))
    result = _measure(nodes, stores[0], 0.4, Behind())
    trained = [episode(seed).actions for seed in range(8) if not is_held_out(seed, 0.4)]
    errors = [np.abs(recorded - np.concatenate(trained).mean(0)).mean(0) for recorded in result.recorded]
    np.testing.assert_allclose(result.constant_errors, np.mean(errors, 0), rtol=1e-5)


def test_units_are_tabulated_where_there_are_some() -> None:
    with_units, without = (
        errors_table(components(open_loop(Behind(), spec, [episode(0)], np.zeros(3))), 1)
        for spec in (SPEC, replace(SPEC, units=("1",) * 3))
    )
    assert "unit" in with_units.heads and "deg" in with_units.rows[0]
    assert "unit" not in without.heads and {len(row) for row in without.rows} == {len(without.heads)}


JOINTS = replace(ROBOT, joints=["a", "b", "c"], low=[-1.5] * 3, high=[1.5] * 3, speed=[2.0] * 3,
                 acceleration=[50.0] * 3, **NO_FINGERS)  # fmt: skip


def test_joint_positions_in_degrees_move_a_robot_in_radians() -> None:
    spec = replace(SPEC, robot=RobotModel(NAMES, ""), control_hz=10.0)
    with pytest.raises(ValueError, match=r"deploy\.safety\.workspace cannot be kept by .* joint positions: set it to"):
        ControlLoop(spec, JOINTS, SAFETY, 50.0)
    world, seen = World(), list[np.ndarray]()
    world.loop = ControlLoop(spec, JOINTS, replace(SAFETY, workspace=None), 50.0)
    world.joints, world.cameras = np.array([0.1, 0.2, 0.3]), [*spec.cameras]
    goal = np.array([[30.0, -45.0, 120.0]], np.float32)  # the last one is clipped to 90 degrees, and by the limits
    world.answer = lambda observation: (seen.append(observation.state), goal)[1]
    held = world.run(0.32)
    world.loop.on_instruction("move", world.now)
    commands = [command.position for command in (*held, *world.run(2.9))]
    assert len(commands) == 150
    np.testing.assert_allclose(seen[0], np.rad2deg([0.1, 0.2, 0.3]), rtol=1e-5)
    np.testing.assert_allclose(commands[-1], [np.pi / 6, -np.pi / 4, 1.45], atol=0.01)
    assert np.abs(np.diff(commands, axis=0)).max() <= 2.0 * 0.02 + 1e-9


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"state_units": ("1",) * 3}, r"joint1\.pos \[1\], .* must have one of the units rad, deg, m: name it with"),
        ({"units": ("1",) * 3}, r"joint1\.pos \[1\], .* must have one of the units"),
        (
            {"action": (*NAMES[:2], "x"), "robot": RobotModel(NAMES[:2], "")},
            r"action has x, which are no joints of its",
        ),
    ],
)
def test_actions_that_no_joint_can_follow_are_refused(change: dict[str, Any], says: str) -> None:
    changed: dict[str, Any] = {"robot": RobotModel(NAMES, ""), "control_hz": 10.0, **change}
    spec = replace(SPEC, **changed)
    with pytest.raises(ValueError, match=says):
        controller_for(spec, None)


def test_a_recorded_world_says_what_contradicts_itself() -> None:
    made = {"cameras": ["a"], "image_size": [8, 8], "control_hz": 5.0, "units": "1", "joints": None}
    with pytest.raises(ValueError, match=r"low of x is 1\.0, not less than high, 0\.0"):
        Recorded(**made, state=["x"], action=["x"], low=[1.0], high=[0.0])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"task\.joints names x, whose unit must be one of rad, deg, m: name it with"):
        Recorded(**{**made, "joints": "all"}, state=["x"], action=["x"], low=[0.0], high=[1.0])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="robot names s, o, m, e, which is not in the state"):
        Recorded(**{**made, "joints": "some"}, state=["x"], action=["x"], low=[0.0], high=[1.0])  # type: ignore[arg-type]


def test_the_mean_action_of_a_million_steps_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    actions, steps = np.full((2_000_000, 2), 0.7, np.float32), 100_000
    entries = [
        SimpleNamespace(seed=number, draws={}, span=slice(number * steps, (number + 1) * steps)) for number in range(20)
    ]
    store: Any = SimpleNamespace(episodes=entries, spec=None, folder="", rows=lambda name: actions)
    options: Any = SimpleNamespace(collect=SimpleNamespace(more=None), evaluate=SimpleNamespace(episodes=1))
    monkeypatch.setattr("vla.jobs.open_loop.open_loop", lambda *arguments: arguments[-1])
    constant: Any = _measure(options, store, 0.3, None)
    np.testing.assert_allclose(constant, 0.7, rtol=1e-6)
