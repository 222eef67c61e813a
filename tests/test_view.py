"""The live view: states when they change, small images without loss, and the arm."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arm import ROBOT
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from exporting import stored
from PIL import Image as Picture
from rerun.chunk import RrdReader
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String

from vla.data.header import Codec
from vla.deploy import messages
from vla.deploy.view import View, expected_pictures
from vla.io.types import Images
from vla.robots.panda import CHAIN
from vla.spec import RobotModel, Shell
from vla.tasks.tabletop.panda import PandaShell

FIGURES = ("image age p50", "image age p99", "inference p50", "inference p99", "tick p50", "tick p99", "wait p50")


def status(words: str) -> DiagnosticStatus:
    """A status message of the agent."""
    values = [KeyValue(key=f"{figure} [ms]", value="12.5") for figure in FIGURES]
    return DiagnosticStatus(name="vla_agent", message=words, values=[*values, KeyValue(key="odd [ms]", value="?")])


@pytest.fixture
def drawn(tmp_path: Path) -> Callable[..., dict[str, list[Any]]]:
    """Draws (topic, message) pairs; gives entity → its chunks of data."""

    def draw(
        *received: tuple[str, Any], shell: Shell | None = None, expected: dict[str, np.ndarray] | None = None
    ) -> dict[str, list[Any]]:
        ignore = SimpleNamespace(
            get_topic_names_and_types=list, create_timer=lambda *arguments: None, destroy_timer=lambda timer: None
        )
        view = View(ignore, tmp_path / "view.rrd", shell, expected)
        for topic, message in received:
            package, kind = type(message).__module__.split(".")[0], type(message).__name__
            callback = view.callback_for(topic, f"{package}/msg/{kind}")
            assert callback is not None
            callback(message)
        view.close()
        chunks = defaultdict(list)
        for chunk in RrdReader(tmp_path / "view.rrd").stream():
            chunks[chunk.entity_path].append(chunk.to_record_batch())
        return chunks

    return draw


def values(chunks: list[Any], component: str) -> list[Any]:
    """All that an entity was given of a component, in order."""
    found = [batch.column(name).to_pylist() for batch in chunks for name in batch.schema.names if component in name]
    return [row[0] for rows in found for row in rows if row]


def test_states_are_said_when_they_change(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    said = [("/vla_agent/status", status(words)) for words in ("running", "running", "stopped", "stopped", "running")]
    words = [("/user/command", String(data=words)) for words in ("go on", "go on", "x" * 1000)]
    texts = values(drawn(*said, *words)["/words"], "text")
    assert texts[:4] == ["vla_agent: running", "vla_agent: stopped", "vla_agent: running", "/user/command: go on"]
    assert len(texts) == 5 and len(texts[4]) < 330


def test_no_two_latencies_have_one_colour(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    chunks = drawn(("/vla_agent/status", status("running")))
    colours = [values(chunks[f"/latency/{figure.replace(' ', '_')}"], "colors") for figure in FIGURES]
    assert all(len(colour) == 1 for colour in colours)
    assert len({colour[0] for colour in colours}) == len(FIGURES) and "/latency/odd" not in chunks


def test_a_small_image_is_drawn_without_loss(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    large = np.zeros((480, 640, 3), np.uint8)
    chunks = drawn(
        ("/front", messages.fill_image(Image(), pixels, "front")),
        ("/large", messages.fill_image(Image(), large, "large")),
    )
    blob = bytes(values(chunks["/camera/front"], "blob")[0])
    np.testing.assert_array_equal(np.array(Picture.open(io.BytesIO(blob))), pixels)
    assert values(chunks["/camera/large"], "media_type") == ["image/jpeg"]


def test_what_is_expected_lies_over_what_a_camera_sees(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    """The live image is cropped and resized as the policy node does it."""
    expected, live = np.full((96, 96, 3), 200, np.uint8), np.zeros((480, 640, 3), np.uint8)
    live[:, 80:-80] = 100  # the part that is cropped
    seen = ("/front", messages.fill_image(Image(), live, "front"))
    chunks = drawn(seen, ("/wrist", messages.fill_image(Image(), live, "wrist")), expected={"/front": expected})
    blob = bytes(values(chunks["/expected/front"], "blob")[0])
    np.testing.assert_array_equal(np.array(Picture.open(io.BytesIO(blob))), np.full((96, 96, 3), 150))
    assert "/expected/wrist" not in chunks and "/camera/wrist" in chunks


@pytest.mark.parametrize("images", ["raw", "lossless"])
def test_the_expected_picture_is_what_episodes_begin_with(tmp_path: Path, images: Images) -> None:
    store, episodes = stored(tmp_path / "store", seeds=range(3), codec=Codec(images))
    camera = store.spec.cameras[0]
    first = np.median([episode.observations[0].rgb[camera] for episode in episodes], axis=0)
    pictures = expected_pictures(store.folder, [f"{camera}=/live"])
    np.testing.assert_array_equal(pictures["/live"], first.astype(np.uint8))
    for wrong in ("eye=/live", camera):
        with pytest.raises(ValueError, match=f"name a topic for cameras of .*, which has {camera}"):
            expected_pictures(store.folder, [wrong])


def described(joints: list[str], fingers: list[str], chain: Any) -> tuple[str, String]:
    """What an agent says of its arm."""
    limits: Any = dict.fromkeys(("high", "speed", "acceleration"), [1.0] * len(joints)) | {"low": [-1.0] * len(joints)}
    robot = replace(ROBOT, joints=joints, fingers=fingers, **limits)
    return "/vla_agent/arm", messages.fill_arm(String(), robot, RobotModel(tuple(joints), "base", chain=chain))


def test_the_arm_stands_as_joint_states_say(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    names = [*(f"fr3_joint{number}" for number in range(7, 0, -1)), "fr3_finger_joint1", "fr3_finger_joint2"]
    still = JointState(name=names, position=[0.0] * 7 + [0.04, 0.04])
    chunks = drawn(
        ("/joint_states", JointState(name=names, position=[0.5] * 9)),  # of an arm that is not known yet
        described(names[6::-1], names[7:], CHAIN),
        ("/isaac/franka/joint_commands", JointState(name=names, position=[1.0] * 9)),
        ("/joint_states", JointState(name=names, position=[float("nan")] * 9)),
        ("/joint_states", JointState(name=names[:3], position=[0.0] * 3)),
        ("/joint_states", still),
        shell=PandaShell(),
    )
    assert "/world/arm" not in chunks
    (hand,) = values(chunks["/world/panda.hand"], "translation")
    np.testing.assert_allclose(hand, [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107], atol=1e-5)
    left, right = (values(chunks[f"/world/panda.{side}_finger"], "translation")[0] for side in ("left", "right"))
    assert np.linalg.norm(np.subtract(left, right)) == pytest.approx(0.08, abs=1e-5)


def test_any_other_arm_is_drawn_as_lines_between_its_joints(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    """Six joints, each 0.1 m above the one before; the first makes a quarter turn, and the tool is beside the last."""
    step, back = (0.0, 0.0, 0.1), (1.0, 1.0, 0.0, 0.0)
    chain = (*((*step, 1.0, 0.0, 0.0, 0.0),) * 6, (0.0, 0.1, 0.0, *back))
    joints, positions = ["base", "shoulder", "elbow", "yaw", "pitch", "roll"], [np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0]
    chunks = drawn(
        described(joints, ["claw"], chain),
        ("/states", JointState(name=["claw", *joints], position=[0.01, *positions])),
        shell=PandaShell(),
    )
    (lines,) = values(chunks["/world/arm"], "strips")
    np.testing.assert_allclose(lines, [[0, 0, 0.1 * each] for each in range(7)] + [[-0.1, 0, 0.6]], atol=1e-6)
    assert not [entity for entity in chunks if "panda" in entity]
    assert {f"/joints/measured/{joint}" for joint in joints} | {"/gripper/measured/claw"} <= {*chunks}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "joints: Field required"),
        ('{"joints": ["a"], "fingers": [], "chain": [[1, 2]]}', "7 numbers for each of 1"),
    ],
)
def test_a_bad_description_of_an_arm_is_said(drawn: Callable[..., dict[str, list[Any]]], text: str, words: str) -> None:
    chunks = drawn(("/vla_agent/arm", String(data=text)), ("/states", JointState(name=["a"], position=[0.0])))
    (said,) = values(chunks["/words"], "text")
    assert words in said and "/joints/measured/a" in chunks and "/world/arm" not in chunks
