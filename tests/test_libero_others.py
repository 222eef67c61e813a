"""What others measure and publish on LIBERO: LIBERO-PRO, controls for memory, served policies, human demonstrations."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pictures
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import here
from composing import check, composed
from lerobot_files import EPISODES, INFO, ROWS, TASKS, info, png
from PIL import Image, ImageOps
from test_libero import PLAIN, solved, world
from websockets.sync.server import ServerConnection, serve

from vla.config.build import build
from vla.config.experiment import Experiment
from vla.data.episodes import EpisodeStore
from vla.io.array_messages import pack, unpack
from vla.io.errors import UserError
from vla.rollouts.evaluate import play_episode
from vla.rollouts.remote import RemotePolicy
from vla.spec import FIRST_SEED, Array
from vla.tasks.libero.controller import REACH
from vla.tasks.libero.expert import Planner
from vla.tasks.libero.package import CHANGES, SUITES, tasks_of
from vla.tasks.world import action_of, command_of

ONE = [*PLAIN, "task.suite=object", "task.tasks=[0]"]
CONDITIONS = ("positions", "objects", "sentences", "tasks")
CLEAN = ("expert.perturb.noise=0", "expert.perturb.missed=0")
QUIET = ("recorder=none", "cluster.workers=1", "logger=none")


def test_pictures_are_nearly_those_that_libero_hands_out(capsys: pytest.CaptureFixture[str]) -> None:
    """Of one task; docs/results/libero.md has all forty."""
    with patch.object(sys, "argv", ["pictures.py", "task.suite=spatial", "task.tasks=[0]"]):
        pictures.main()
    assert max(map(float, capsys.readouterr().out.splitlines()[0].split()[1:])) < 5


def test_libero_pro_changes_one_thing_at_a_time() -> None:
    differing = {"swap": {"initial"}, "object": {"scene"}, "lan": {"instruction"}, "task": {"instruction", "goal"}}
    for change in CHANGES:
        differs: dict[str, list[bool]] = {"instruction": [], "goal": [], "scene": [], "initial": []}
        for suite in SUITES:
            for before, after in zip(tasks_of(suite), tasks_of(f"{suite}_{change}"), strict=True):
                for name, found in differs.items():
                    found.append(getattr(before, name) != getattr(after, name))
        mostly = {name for name, found in differs.items() if np.mean(found) > 0.9}
        never = {name for name, found in differs.items() if not any(found)}
        assert differing[change] <= mostly, change
        assert {"instruction", "goal"} - differing[change] <= never | ({"goal"} if change == "object" else set()), (
            change
        )


@pytest.mark.parametrize("name", ["goal_object 8", "spatial_lan 0", "object_task 0"])  # the second a bowl by its rim
def test_the_planner_plays_what_libero_pro_changes(name: str) -> None:
    with closing(world(name)) as environment, environment.blind():
        solved(environment, FIRST_SEED)
        assert environment.draws["start"]["official"] == 0


def test_libero_pro_is_an_evaluation_with_a_paired_difference_per_change(tmp_path: Path) -> None:
    whole = composed("job=evaluate", "task=libero", "evaluate=libero_pro", "agent=expert")
    check(whole)
    changes = {name: f"{whole.task.suite}_{change}" for name, change in zip(CONDITIONS, CHANGES, strict=True)}
    assert {name: one.suite for name, one in whole.evaluate.conditions.items()} == changes
    asked = ["evaluate=libero_pro", "agent=expert", "evaluate.episodes=1", "output=pro", "evaluate.recordings=0"]
    others = (f"~evaluate.conditions.{name}" for name in CONDITIONS[1:])
    here(tmp_path, *ONE, *QUIET, *CLEAN, *asked, *others)
    report = json.loads((tmp_path / "pro/report.json").read_text())
    assert {name: told["success"] for name, told in report["conditions"].items()} == {"positions": 1.0}
    assert {suite: part["of"] for suite, part in report["tiers"].items()} == {"object": 1}


@contextmanager
def expert_behind_openpi(asked: list[dict[str, Any]]) -> Iterator[str]:
    """A server as openpi's, by its URL, that gives the expert's commands to an episode that it plays along."""

    def answer(connection: ServerConnection) -> None:
        connection.send(pack({}))
        with closing(world("object 0")) as environment, environment.blind():
            expert, seen = Planner(spec=environment.spec), environment.reset(FIRST_SEED)
            for data in connection:
                assert isinstance(data, bytes)
                asked.append(unpack(data))
                np.testing.assert_allclose(asked[-1]["observation/state"], seen.state, atol=1e-4)
                commands = np.zeros((10, 7), np.float32)
                for command in commands[:5]:
                    if not environment.done:
                        action = expert.act(seen)
                        command[:] = command_of(action, REACH)
                        seen = environment.step(action)
                connection.send(pack({"actions": commands, "server_timing": {"infer_ms": 1.0}}))

    with serve(answer, "127.0.0.1", 0, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()


def test_a_served_policy_is_judged_with_the_keys_of_openpi(caplog: pytest.LogCaptureFixture) -> None:
    asked: list[dict[str, Any]] = []
    with expert_behind_openpi(asked) as url, closing(world("object 0")) as environment:
        picture = environment.reset(FIRST_SEED).rgb["agentview"]
        config = composed(*ONE, "agent=remote_libero", f"agent.url={url}")
        make = Experiment.from_config(config).make_agent()
        policy = make(environment) if make else None
        assert isinstance(policy, RemotePolicy)
        with closing(policy):
            result = play_episode(environment, policy, FIRST_SEED)
    assert result.outcome == "success" and len(asked) == -(-result.steps // 5)
    assert "images of 48 x 48 px are enlarged to the 224 x 224 px of agent.image_size" in caplog.text
    first = asked[0]
    assert first.keys() == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
    assert first["prompt"] == "pick up the alphabet soup and place it in the basket"
    assert first["observation/state"].shape == (8,) and first["observation/wrist_image"].shape == (224, 224, 3)
    whole = ImageOps.pad(Image.fromarray(picture), (224, 224), Image.Resampling.BILINEAR)
    np.testing.assert_array_equal(first["observation/image"], np.array(whole))


def published(folder: Path, commands: Array, states: Array, picture: Image.Image) -> Path:
    """A dataset of two episodes of three steps as LeRobot publishes LIBERO's."""
    steps, floats = np.arange(6), pa.list_(pa.float32())
    cameras = "observation.images.image", "observation.images.image2"
    tables = {
        ROWS: {
            "observation.state": pa.array(states.tolist(), floats),
            "action": pa.array(commands.tolist(), floats),
            **dict.fromkeys(cameras, [{"bytes": png(picture), "path": None}] * 6),
            **{"timestamp": pa.array((steps % 3 / 10).astype(np.float32)), "frame_index": steps % 3},
            **{"episode_index": steps // 3, "index": steps, "task_index": steps // 3},
        },
        EPISODES: {"episode_index": [0, 1], "dataset_from_index": [0, 3], "dataset_to_index": [3, 6]},
        TASKS: {"task_index": [0, 1], "task": ["put the bowl on the plate", "turn on the stove"]},
    }
    for path, table in tables.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), folder / path)
    image = {"dtype": "image", "shape": [256, 256, 3], "names": ["height", "width", "channel"]}
    axes = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
    features = {
        **{camera: image for camera in cameras},
        "observation.state": {"dtype": "float32", "shape": [8], "names": {"motors": [*axes, "gripper"]}},
        "action": {"dtype": "float32", "shape": [7], "names": {"motors": axes}},
    }
    head = {"codebase_version": "v3.0", "fps": 10, "total_episodes": 2, "total_frames": 6}
    (folder / INFO).write_text(json.dumps({**head, "features": features}))
    return folder


def test_human_demonstrations_become_episodes_of_this_world(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    commands, states = random.uniform(-1, 1, (6, 7)).astype(np.float32), random.normal(size=(6, 8)).astype(np.float32)
    commands[:, 6] = np.sign(commands[:, 6])
    picture = Image.fromarray(np.tile(np.arange(256, dtype=np.uint8)[:, None], (256, 1, 3)))
    folder = published(tmp_path / "libero", commands, states, picture)
    config = Experiment.from_config(composed(*PLAIN, "expert=lerobot_libero", f"expert.folder={folder}"))
    with closing(world()) as environment:
        demonstrations = build(config["expert"], "expert", spec=environment.spec)
        store = EpisodeStore.create_or_open(tmp_path / "store", environment.spec.without_truth, {})
    assert demonstrations.fill(store, 2) == 2
    assert [entry.instruction for entry in store.episodes] == ["put the bowl on the plate", "turn on the stove"]
    found = [store.read(entry) for entry in store.episodes]
    np.testing.assert_array_equal(np.concatenate([one["state"] for one in found]), states)
    np.testing.assert_allclose(
        np.concatenate([one["action"] for one in found]), [action_of(one, REACH) for one in commands], atol=1e-6
    )
    left, right = found[0]["rgb_agentview"][0, 24, [2, 45], 0].astype(int)
    assert left < 20 and right > 235  # neither mirrored once more nor cropped


def test_a_dataset_of_something_else_ends_in_a_sentence(tmp_path: Path) -> None:
    folder = published(tmp_path / "libero", np.zeros((6, 7)), np.zeros((6, 7)), Image.new("RGB", (256, 256)))
    info(lambda content: content["features"]["observation.state"].update(shape=[7], names=None))(folder)
    config = Experiment.from_config(composed(*PLAIN, "expert=lerobot_libero", f"expert.folder={folder}"))
    with closing(world()) as environment, pytest.raises(UserError, match=r"state has 7 numbers .* that of the task 8"):
        build(config["expert"], "expert", spec=environment.spec)
