"""A bag says the same as the episode it came from, to any reader of rosbag2 and to Rerun."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exporting import exporter, stored
from rerun.chunk import RrdReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from toy import ARM_SPEC

from vla.data.episodes import EpisodeStore

ROBOT = [f"panda_joint{index}" for index in range(1, 8)]
CAMERAS = {"front": "/isaac/camera", "wrist": "/isaac/wrist_camera"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A `store` of two episodes, and the `bags` made of it."""
    home = tmp_path_factory.mktemp("home")
    exporter("mcap", home / "bags").export(stored(home / "store")[0])
    return home


def heard(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic → time stamps [ns] and messages."""
    types, messages = get_typestore(Stores.ROS2_JAZZY), defaultdict(list)
    with Reader(bag) as reader:
        for connection, stamp, message in reader.messages():
            messages[connection.topic].append((stamp, types.deserialize_cdr(message, connection.msgtype)))
    return messages


def test_every_message_is_a_row_of_the_store(home: Path) -> None:
    store = EpisodeStore(home / "store")
    for number, entry in enumerate(store.episodes):
        rows, topics = store.read(entry), heard(home / f"bags/episode_{number:05d}")
        assert [message.data for _, message in topics["/user/command"]] == [entry.instruction]
        for camera, topic in CAMERAS.items():
            assert len(topics[f"{topic}/image_raw"]) == entry.steps
            for step, (stamp, image) in enumerate(topics[f"{topic}/image_raw"]):
                assert stamp == 1_000_000_000 + step * 100_000_000  # 10 Hz
                assert image.header.stamp.sec * 1_000_000_000 + image.header.stamp.nanosec == stamp
                assert (image.encoding, image.height, image.width, image.step) == ("rgb8", 16, 16, 48)
                np.testing.assert_array_equal(image.data.reshape(16, 16, 3), rows[f"rgb_{camera}"][step])
            for step, (_, image) in enumerate(topics[f"{topic}/depth"]):
                assert (image.encoding, image.is_bigendian, image.step) == ("16UC1", 0, 32)
                depth = np.frombuffer(image.data.tobytes(), "<u2").reshape(16, 16)
                np.testing.assert_array_equal(depth, rows[f"depth_{camera}"][step])
        for step, (_, state) in enumerate(topics["/isaac/franka/joint_states"]):
            assert state.name == [*ROBOT, "panda_finger_joint1", "panda_finger_joint2"]
            np.testing.assert_array_equal(np.float32(state.position[:7]), rows["state"][step, :7])
            np.testing.assert_array_equal(np.float32(state.velocity[:7]), rows["state"][step, 7:14])
            assert np.float32(state.position[7:].sum()) == rows["state"][step, 14]
        for topic, field in (("/vla/action", "action"), ("/vla/executed_action", "executed")):
            np.testing.assert_array_equal([message.data for _, message in topics[topic]], rows[field])
            assert topics[topic][0][1].layout.dim[0].label == "x y gripper"
        manifest = json.loads((home / f"bags/episode_{number:05d}/manifest.json").read_text())
        assert manifest["seed"] == entry.seed and manifest["spec"]["units"] == list(ARM_SPEC.units)


def test_rerun_converts_it(home: Path, tmp_path: Path) -> None:
    bag = home / "bags/episode_00000/episode_00000.mcap"
    for command in (["check", str(bag)], ["convert", str(bag), "-o", str(tmp_path / "bag.rrd")]):
        done = subprocess.run([sys.executable, "-m", "rerun", "mcap", *command], capture_output=True, timeout=60)
        assert done.returncode == 0, done.stderr
    seen = {chunk.entity_path for chunk in RrdReader(tmp_path / "bag.rrd").stream()}
    assert {"/isaac/camera/image_raw", "/isaac/wrist_camera/depth", "/vla/action"} <= seen


def test_other_files_or_topics_are_told_from_the_same_ones(home: Path, tmp_path: Path) -> None:
    store = EpisodeStore(home / "store")
    exporter("mcap", home / "bags").export(store)
    for name, options in (("mcap", ("export.action=/elsewhere",)), ("files", ())):
        with pytest.raises(ValueError, match=r"or as other files: choose another export\.folder"):
            exporter(name, home / "bags", *options).export(store)


def test_without_rosbags_the_sentence_says_what_to_install(tmp_path: Path) -> None:
    script = tmp_path / "export.py"
    script.write_text(
        "import sys; sys.modules['rosbags'] = None\n"
        "from pathlib import Path; from exporting import exporter; exporter('mcap', Path('x'))\n"
    )
    tests = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, str(script)],
        env={"PYTHONPATH": f"{tests}:{tests.parent}", "PATH": ""},
        capture_output=True,
        text=True,
    )
    assert "UserError: export=mcap needs the package rosbags" in done.stderr


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("~export.topics.images.wrist", r"export\.topics\.images has no topic for wrist: it has front"),
        ("~export.depths.front", r"export\.depths has no topic for front: it has wrist"),
        ("export.robot.joints=[one]", "needs one entry per joint"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused(home: Path, tmp_path: Path, override: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        exporter("mcap", tmp_path / "bags", override).export(EpisodeStore(home / "store"))
    assert list(tmp_path.iterdir()) == []
