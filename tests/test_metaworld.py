"""Meta-World: its episodes and experts, its pictures against MuJoCo's and LeRobot's, and the jobs in it."""

from __future__ import annotations

import json
import re
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import metaworld_client
import metaworld_loops
import mujoco
import numpy as np
import psutil
import pytest
from command_line import here
from composing import composed
from defaults import defaults_of
from documented import ROOT
from hydra.utils import instantiate
from PIL import Image
from replaying import played, same
from saved_policies import save_policy
from websockets.sync.client import connect

from vla.api import load_policy
from vla.config.experiment import Experiment, to_plain
from vla.data.episodes import EpisodeStore
from vla.deploy.client_observation import Keys
from vla.deploy.server import PolicyServer, Service
from vla.envs.lerobot import IMAGE, STATE, TASK, observations
from vla.parallel.pool import THIS_PROCESS
from vla.rollouts.collect import collect
from vla.rollouts.rollout import rollout
from vla.spec import Array, Environment, Multitask, Observation, Spec
from vla.tasks.metaworld import package
from vla.tasks.metaworld.environment import REACH, MetaWorld
from vla.tasks.metaworld.expert import Scripted
from vla.tasks.world import command_of

LEROBOT = (0.75, 0.075, 0.7)  # where it puts the camera corner2 [m]


def experiment(*overrides: str) -> Experiment:
    return Experiment.from_config(composed("task=metaworld", *overrides))


def world(*overrides: str) -> MetaWorld:
    made = experiment("task.image_size=[96,96]", *overrides).make_environment()()
    assert isinstance(made, MetaWorld)
    return made


def test_a_policy_trained_on_lerobots_data_gives_the_commands_of_meta_world() -> None:
    asked = composed("task=metaworld", "agent=remote_metaworld").agent
    theirs = np.array([1.0, -0.5, 0.25, 1.0])  # the last closes
    ours = [each.scale * theirs[each.index] for each in map(instantiate, asked.actions.values())]
    assert [*asked.actions] == list(world().spec.action) and asked.images.corner2 == "observation/image"
    np.testing.assert_allclose(command_of(np.array(ours), REACH), theirs)


def test_a_seed_is_the_same_episode_also_where_memory_is_scarce_and_tasks_are_compiled_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compiled: list[str] = []
    with closing(world("task.tasks=[coffee-push,door-open,stick-pull]")) as environment:
        make = environment._make_scene
        monkeypatch.setattr(environment, "_make_scene", lambda task: compiled.append(task) or make(task))
        before = {seed: played(environment, seed, 5) for seed in (3, 4, 5)}
        assert not same(before[3], played(environment, 6, 5))  # the same task at another place
        assert all(same(before[seed], played(environment, seed, 5)) for seed in (5, 4, 3))
        assert compiled == ["coffee-push", "door-open", "stick-pull"]
        scarce = psutil.virtual_memory()._replace(available=0)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: scarce)
        environment.close()
        assert all(same(before[seed], played(environment, seed, 5)) for seed in (3, 4, 3, 5))
        assert compiled[3:] == ["coffee-push", "door-open", "coffee-push", "stick-pull"]


def test_what_nobody_touches_stands_still() -> None:
    thermos = slice(11, 14)
    with closing(world("task.tasks=[stick-push,stick-pull]")) as environment, environment.blind():
        for seed in (0, 1):
            before = environment.reset(seed).truth or {}
            for _ in range(10):
                later = environment.step(np.zeros(4)).truth or {}
            moved = later["observation"][thermos] - before["observation"][thermos]
            assert np.abs(moved).max() < 0.002  # [m]


def test_states_and_actions_are_those_of_the_spec() -> None:
    environment = world("task.tasks=[push]")
    spec = environment.spec
    assert spec.action == ("dx", "dy", "dz", "gripper") and spec.units == ("m", "m", "m", "1")
    assert spec.state == ("hand_x", "hand_y", "hand_z", "opening") and spec.control_hz == 80
    with environment.blind():
        start = environment.reset(0)
        for _ in range(15):
            there = environment.step(np.array([0.01, -0.005, 0.002, -1.0]))
        assert there.rgb == {} and there.state.shape == (4,) and there.state.dtype == np.float32
        moved = there.state - start.state
        np.testing.assert_allclose(moved[:3] / moved[0], [1, -0.5, 0.2], atol=0.1)  # the hand lags behind the command
        assert start.state[3] - there.state[3] > 0.3  # -1 closes
        for _ in range(15):
            there = environment.step(np.array([0, 0, 0, 1.0]))
        assert there.state[3] > 0.9  # and 1 opens
    truth = there.truth or {}
    assert truth["object"].shape == truth["goal"].shape == (3,)
    assert environment.draws["goal"]["place"] == truth["goal"][:2].tolist()


def test_the_first_observation_of_every_task_has_the_places_of_the_objects() -> None:
    """They are those of one step later, but for what moves by itself: the most is a door that is pushed open, 19 mm."""
    environment = world()
    assert len(environment.tasks) == 50
    with environment.blind():
        for seed, task in enumerate(environment.tasks):
            first = environment.reset(seed).truth or {}
            later = environment.step(np.array([0.0, 0.0, 0.0, 1.0])).truth or {}
            np.testing.assert_allclose(first["observation"][:18], later["observation"][:18], atol=0.02, err_msg=task)
            assert np.array_equal(first["observation"][:18], first["observation"][18:36])
            assert np.array_equal(first["goal"], later["goal"]), task
    environment.close()


def test_experts_solve_tasks_in_turn_within_the_bounds() -> None:
    tasks = ("button-press", "pick-place", "assembly", "handle-pull")
    environment = world(f"task.tasks=[{','.join(tasks)}]")
    expert = Scripted(spec=environment.spec)
    with environment.blind():
        episodes = [rollout(environment, expert, seed) for seed in range(8)]
    assert [(episode.task, episode.outcome) for episode in episodes] == [(task, "success") for task in tasks * 2]
    assert isinstance(environment, Multitask) and environment.task_of(7) == "handle-pull"
    for episode in episodes:
        assert (np.abs(episode.actions) <= np.array(environment.spec.high, np.float32)).all()
        assert 20 < len(episode.actions) < 250
        fresh = Scripted(spec=environment.spec)  # which saw nothing of what was before
        assert fresh.memoryless and np.array_equal(fresh.act(episode.observations[19]), episode.actions[19])


def test_an_episode_ends_after_its_steps() -> None:
    environment = world("task.tasks=[assembly]", "task.steps=3")
    with environment.blind():
        played(environment, 0, 3)
        assert environment.done and environment.outcome == "timeout"
        with pytest.raises(ValueError, match="call reset"):
            environment.step(np.zeros(4))


def test_sentences_are_lerobots_and_can_be_told_apart() -> None:
    task = experiment()["task"]
    tasks = package.tasks_of("mt50")
    assert len(tasks) == 50 and {*task["sentences"]} == {*tasks}
    shared = [sentence for sentence, count in Counter(task["sentences"].values()).items() if count > 1]
    assert shared == ["Push the puck to a goal"] == [task["sentences"]["push-back"]]
    sizes = {tier: len(names) for tier, names in task["tiers"].items()}
    assert sizes == {"easy": 28, "medium": 11, "hard": 6, "very_hard": 5}
    assert sorted(name for names in task["tiers"].values() for name in names) == sorted(tasks)
    environment = world("task.tasks=[push-back]", "task.sentences.push-back='Push the puck back to a goal'")
    with environment.blind():
        assert environment.reset(0).instruction == "Push the puck back to a goal"
    assert world("task.tasks=mt10").tasks == package.tasks_of("mt10") and len(package.tasks_of("mt10")) == 10
    assert world("task.tasks=mt1").tasks == ("reach",)


def after(environment: Environment, seed: int, steps: int) -> Observation:
    """What is seen after so many steps with random actions, and one of rest."""
    with environment.blind():
        played(environment, seed, steps)
    return environment.step(np.zeros(4))


def apart(one: Observation, other: Observation, camera: str) -> Array:
    """How many grey levels the pictures of a camera are apart."""
    return np.abs(one.rgb[camera].astype(int) - other.rgb[camera])


def test_the_experiment_draws_what_lerobots_images_show() -> None:
    chosen = experiment("experiment=metaworld", "task.tasks=[basketball,soccer]")
    changes = experiment("evaluate=lerobot")["evaluate"]["conditions"]["lerobot"]
    with closing(chosen.make_environment()()) as ours, closing(chosen.make_environment(changes)()) as theirs:
        for seed in (0, 1):
            one, other = (after(made, seed, 9) for made in (ours, theirs))
            for camera in ("corner2", "hand"):
                levels = apart(one, other, camera)
                # Without the shadows, they are 11 apart.
                assert levels.mean() < 4 and (levels > 40).mean() < 0.01


def lerobots_picture(task: str, seed: int) -> Array:
    """Its picture (480, 480, 3) after one step, drawn as it does."""
    classes = package.env_dict.ALL_V3_ENVIRONMENTS
    simulator = classes[task + package.VERSION](render_mode="rgb_array", camera_name="corner2")
    simulator._partially_observable, simulator._set_task_called = False, True
    simulator._freeze_rand_vec, simulator.seeded_rand_vec = False, True
    simulator.__dict__.pop("sawyer_observation_space", None)
    simulator.model.cam_pos[2] = LEROBOT
    simulator.seed(seed)
    simulator.reset(seed=seed)
    simulator.step(np.zeros(4, np.float32))
    picture = np.ascontiguousarray(np.flip(simulator.render(), (0, 1)))
    simulator.close()
    return picture


def test_images_are_lerobots_where_they_are_asked_for() -> None:
    changes = experiment("evaluate=lerobot")["evaluate"]["conditions"]["lerobot"]
    top, left, bottom, right = window = 0.25, 0.29, 0.95, 0.99
    shown = experiment("task.tasks=[soccer]", f"task.window={[*window]}")
    with closing(shown.make_environment(changes)()) as environment:
        ours = after(environment, 7, 0).rgb["corner2"]
    box = 480 * left, 480 * top, 480 * right, 480 * bottom
    theirs = Image.fromarray(lerobots_picture("soccer", 7)).resize((96, 96), Image.Resampling.BOX, box)
    assert np.abs(np.asarray(theirs).astype(int) - ours).max() <= 2


def test_images_that_are_parts_of_a_picture_are_not_taken_from_whole_ones() -> None:
    spec = world(
        "task.cameras=[corner2,hand,topview]", "task.window=[0.25,0.29,0.95,0.99]", "task.image_size=[96,96]"
    ).spec
    assert spec.cut == ("corner2", "hand") and world("task.cameras=[corner2]").spec.cut == ()
    whole_beside_hand = world("task.cameras=[corner2,hand]").spec
    assert whole_beside_hand.required_images(["picture"]) == ["picture"] and whole_beside_hand.size("picture") == (
        480,
        480,
    )
    keys = Keys({"corner2": "image", "hand": "hand", "topview": "top"}, ["state"], "prompt")
    whole, part = np.zeros((480, 480, 3), np.uint8), np.zeros((96, 96, 3), np.uint8)
    sent = {"image": part, "hand": part, "top": whole, "state": np.zeros(4), "prompt": "Reach a goal position"}
    assert [image.shape[0] for image in keys.observation(sent, spec).rgb.values()] == [96, 96, 480]
    for key, camera in (("image", "corner2"), ("hand", "hand")):
        with pytest.raises(ValueError, match=f"^{key} has 480 by 480 pixels, but {camera} shows a part of .*96 by 96"):
            keys.observation({**sent, key: whole}, spec)


Parts = tuple[Spec, list[tuple[Observation, Observation]]]
CHOSEN = "task.tasks=[pick-place,door-open]", "task.cameras=[corner2,hand]"
MUJOCO = "task/renderer=mujoco"


@pytest.fixture(scope="module")
def parts() -> Parts:
    """The spec of a world whose images are parts of LeRobot's picture; what is seen with that picture, and with parts.

    That is at the start of two episodes and later, in turn.
    """
    seen: list[list[Observation]] = []
    cut = "task.drawn=480", "task.window=[0.25,0.29,0.95,0.99]"
    for overrides in ((CHOSEN[0], "task.image_size=[480,480]"), (*CHOSEN, *cut)):
        with closing(world(*overrides, MUJOCO)) as made:
            seen.append([look for seed in (0, 1) for look in (made.reset(seed), after(made, seed, 12))])
    return made.spec, [*zip(*seen, strict=True)]


def test_anybody_who_has_lerobots_picture_and_the_state_gives_the_images_of_the_policy(parts: Parts) -> None:
    spec, seen = parts
    keys = Keys({"picture": "image"}, ["state"], "prompt")
    assert spec.required_images(keys.images) == ["picture"] and world().spec.required_images(keys.images) == ["corner2"]
    for whole, own in seen:
        sent = {"image": whole.rgb["corner2"], "state": whole.state, "prompt": whole.instruction}
        shown = spec.images(keys.observation(sent, spec))
        for camera in ("corner2", "hand"):
            np.testing.assert_array_equal(shown[camera], own.rgb[camera])
    picture = whole.rgb["corner2"].transpose(2, 0, 1)[None] / np.float32(255)
    (read,) = observations({IMAGE: picture, STATE: whole.state[None], TASK: [whole.instruction]}, spec)
    np.testing.assert_array_equal(spec.images(read)["hand"], own.rgb["hand"])
    (read,) = observations({IMAGE: picture, STATE: whole.state[None], TASK: [whole.instruction]}, world().spec)
    np.testing.assert_array_equal(read.rgb["corner2"], whole.rgb["corner2"])  # a policy with all of it
    given = {"picture": whole.rgb["corner2"], "state": whole.state, "instruction": "Reach a goal position"}
    assert {*Observation.from_mapping(given, spec).rgb} == {"picture"}
    with pytest.raises(ValueError, match=r'^the image "picture" must be \(H, W, 3\) uint8, and is float32 of \(480,'):
        spec.images(Observation({"picture": np.zeros((480, 480), np.float32)}, whole.state, ""))
    assert Spec.from_dict(spec.to_dict()) == spec


def below_the_hand(state: Array) -> tuple[float, float]:
    """Row and column of the point 75 mm below the hand in LeRobot's picture, by MuJoCo's camera."""
    simulator = package.simulator("pick-place")
    camera, axes = simulator.model.camera("corner2"), np.empty(9)
    mujoco.mju_quat2Mat(axes, camera.quat)
    across, up, behind = axes.reshape(3, 3).T @ (state[:3] - (0, 0, 0.075) - LEROBOT)
    scale = 240 / np.tan(np.radians(camera.fovy[0] / 2)) / behind
    simulator.close()
    return 240 - scale * up, 240 + scale * across  # LeRobot turns the picture


def test_the_hands_picture_is_the_part_of_lerobots_that_the_page_says(parts: Parts) -> None:
    page = (ROOT / "docs/results/metaworld.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for whole, own in parts[1]:
        said: dict[str, Any] = {"np": np, "state": whole.state, "picture": whole.rgb["corner2"]}
        exec(code, said)
        np.testing.assert_array_equal(said["hand"], own.rgb["hand"])
        middle = said["top"] + 48, said["left"] + 48
        np.testing.assert_allclose(middle, below_the_hand(whole.state), atol=0.501)  # whole pixels


def test_the_hands_picture_is_a_part_of_lerobots_that_moves_along(parts: Parts) -> None:
    places = []
    for whole, own in parts[1][:2]:
        windows = np.lib.stride_tricks.sliding_window_view(whole.rgb["corner2"], (96, 96, 3))[:, :, 0]
        alike = np.argwhere((windows[:, :, 0, 0] == own.rgb["hand"][0, 0]).all(-1))
        places += [place for place in alike.tolist() if np.array_equal(windows[tuple(place)], own.rgb["hand"])]
    assert len(places) == 2 and places[0] != places[1]


def test_the_fast_renderer_draws_what_mujocos_does(parts: Parts) -> None:
    with closing(world(*CHOSEN)) as fast, closing(world(*CHOSEN, MUJOCO)) as mujocos:
        for seed, (_, own) in enumerate(parts[1][1::2]):
            one, other = (after(made, seed, 12) for made in (fast, mujocos))
            for camera in ("corner2", "hand"):
                assert apart(one, other, camera).mean() < 4 and one.rgb[camera].std() > 30
            assert apart(other, own, "hand").mean() < 0.1


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task.tasks=[reach,fly]", "Meta-World has no task fly: it has assembly, basketball"),
        ("task.tasks=[reach] task.cameras=[corner2,wrist]", "task.cameras names wrist; Meta-World has topview, corner"),
        ("task.tasks=[reach] task.window=[0.5,0,0.4,1]", "with top < bottom and left < right"),
        ("task.image_size=[96,128]", r"task.image_size=\[96, 128\] would stretch what corner2 shows, which is square"),
        ("task.image_size=[96,128] task.cameras=[corner2,hand] task.window=[0,0,0.6,0.8]", "what hand shows, which"),
    ],
)
def test_unknown_tasks_cameras_and_windows_are_refused(override: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        world(*override.split()).reset(0)


def test_perturbed_demonstrations_are_clean_labels_in_equal_shares(tmp_path: Path) -> None:
    tasks = "task.tasks=[handle-press,coffee-button]"
    asked = experiment(tasks, "task.image_size=[16,16]", "expert=metaworld_perturbed")
    environment = asked.make_environment()()
    assert isinstance(environment, Multitask)
    store = EpisodeStore.create_or_open(tmp_path, environment.spec, {})
    collect(store, asked.make_environment(), asked.make_expert(), 2, THIS_PROCESS, 0, environment)
    assert [entry.task for entry in store.episodes] == ["handle-press", "coffee-button"]
    rows = [store.read(entry) for entry in store.episodes]
    assert {(each["truth"].shape[1], each["state"].shape[1]) for each in rows} == {(6, 4)}
    apart = np.concatenate([np.abs(each["action"] - each["executed"]).max(axis=1) for each in rows])
    assert (apart > 1e-3).mean() > 0.2


def test_it_is_collected_learnt_and_reported_by_tier(tmp_path: Path) -> None:
    printed = here(
        tmp_path,
        *("task=metaworld", "task.tasks=[handle-press,coffee-push]", "task.image_size=[32,32]", "task.steps=80"),
        *("collect.episodes=2", "cluster.workers=1", "trainer.accelerator=cpu", "trainer.max_steps=2"),
        *("validate.episodes=0", "trainer.val_check_interval=2", "data.batch_size=4", "data.validation_fraction=0"),
        *("model.width=16", "model.keypoints=4", "model.text_width=8", "evaluate.episodes=2", "recorder=none"),
        "output=run",
    ).stdout
    assert re.search(
        r"^easy \d/1 .*\nmedium \d/1 .*\nmean over tiers \(2 of 50 tasks\) .*\nsuccess \d/2 ", printed, re.MULTILINE
    )
    report = json.loads((tmp_path / "run/report.json").read_text())
    assert [*report["tiers"]] == ["easy", "medium"] and {*report["tasks"]} == {"handle-press", "coffee-push"}
    assert 0 <= report["mean_over_tiers"]["ci_low"] <= report["mean_over_tiers"]["ci_high"] <= 1
    assert report["per_episode"][1]["draws"]["object"]["height"] > 0
    page = (tmp_path / "run/report.html").read_text()
    assert "Success by tier of difficulty" in page and "mean over tiers" in page


def test_a_client_plays_a_served_policy_on_lerobots_picture_and_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ("model.width=16", "model.keypoints=4", "model.text_width=8", "task.tasks=[reach]", "task.steps=5")
    config = composed("experiment=metaworld", *small)
    asked = Experiment.from_config(config)
    spec = asked.world().spec
    run = save_policy(tmp_path / "run", to_plain(config), spec, state=asked.learner(spec).model.state_dict())
    policy, folder = load_policy(run, device="cpu"), str(tmp_path / "played")
    keys = Keys({"picture": "observation/image"}, ["observation/state"], "prompt")
    made: dict[str, Any] = {"policy": lambda: policy, "environment": asked.make_environment(), "output": tmp_path}
    server = PolicyServer(**defaults_of("deploy/server", port=0, keys=keys, api_key=None), **made)
    monkeypatch.setattr(metaworld_client, "STEPS", 5)
    with Service(server, policy).serve_in_thread() as url:
        with connect(url, compression=None, max_size=None) as socket:
            assert metaworld_client.Server(socket).about["images"] == {"observation/image": [480, 480, 3]}
        metaworld_client.main("1000000", "1", folder, "reach", url)
    metaworld_loops.main(str(run), "1000000", folder)
    printed = capsys.readouterr().out
    assert re.search(r"^reach +0 of 1$", printed, re.MULTILINE)
    assert "here: 0 of 1" in printed and "in LeRobot minus here: 0.0 points" in printed
