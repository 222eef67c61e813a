"""What the live view draws of messages: states when they change, small images without loss, and the arm."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from PIL import Image as Picture
from rerun.chunk import RrdReader
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String

from vla.deploy import messages
from vla.deploy.view import View

FIGURES = ("image age p50", "image age p99", "inference p50", "inference p99", "tick p50", "tick p99", "wait p50")


def status(words: str) -> DiagnosticStatus:
    """What an agent says of itself."""
    values = [KeyValue(key=f"{figure} [ms]", value="12.5") for figure in FIGURES]
    return DiagnosticStatus(name="vla_agent", message=words, values=[*values, KeyValue(key="odd [ms]", value="?")])


@pytest.fixture
def drawn(tmp_path: Path) -> Callable[..., dict[str, list[Any]]]:
    """Draws (topic, message) pairs; gives entity → its chunks of data."""

    def draw(*heard: tuple[str, Any]) -> dict[str, list[Any]]:
        ignore = SimpleNamespace(
            get_topic_names_and_types=list, create_timer=lambda *arguments: None, destroy_timer=lambda timer: None
        )
        view = View(ignore, tmp_path / "view.rrd")
        for topic, message in heard:
            package, kind = type(message).__module__.split(".")[0], type(message).__name__
            hear = view.hearer(topic, f"{package}/msg/{kind}")
            assert hear is not None
            hear(message)
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


def test_the_arm_stands_as_joint_states_say(drawn: Callable[..., dict[str, list[Any]]]) -> None:
    names = [*(f"fr3_joint{number}" for number in range(7, 0, -1)), "fr3_finger_joint1", "fr3_finger_joint2"]
    still = JointState(name=names, position=[0.0] * 7 + [0.04, 0.04])
    chunks = drawn(
        ("/isaac/franka/joint_commands", JointState(name=names, position=[1.0] * 9)),
        ("/joint_states", JointState(name=names, position=[float("nan")] * 9)),
        ("/joint_states", JointState(name=names[:3], position=[0.0] * 3)),
        ("/joint_states", still),
    )
    (hand,) = values(chunks["/world/panda.hand"], "translation")
    np.testing.assert_allclose(hand, [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107], atol=1e-5)
    left, right = (values(chunks[f"/world/panda.{side}_finger"], "translation")[0] for side in ("left", "right"))
    assert np.linalg.norm(np.subtract(left, right)) == pytest.approx(0.08, abs=1e-5)
