"""Messages as arrays: invalid messages are refused."""

from __future__ import annotations

import io
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from zlib import crc32

import numpy as np
import pytest
from arm import ROBOT as PANDA
from PIL import Image

from vla.deploy import commands, messages
from vla.deploy.motion import Command

ROBOT = replace(PANDA, joints=["one", "two"], low=[-1.0] * 2, high=[2.0] * 2, speed=[1.0] * 2, acceleration=[1.0] * 2)
PIXELS = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)  # (H, W, 3)


def image(**changed: Any) -> Any:
    """A message as the camera sends it."""
    message = SimpleNamespace(header=SimpleNamespace(frame_id=""))
    messages.fill_image(message, PIXELS, "camera")
    return SimpleNamespace(**{**vars(message), **changed})


def joints(**changed: Any) -> Any:
    """Joint states in an order of their own, with one more joint than asked for."""
    given = {
        "name": ["left", "two", "elsewhere", "one", "right"],
        "position": [0.03, 2.0, 9.0, 1.0, 0.01],
        "velocity": [0.0, 0.2, 9.0, 0.1, 0.0],
    }
    return SimpleNamespace(**{**given, **changed})


def test_padded_rows_and_other_encodings_are_understood() -> None:
    np.testing.assert_array_equal(messages.image_from(image()), PIXELS)
    padded = np.full((2, 16), 255, np.uint8)
    padded[:, :12] = np.concatenate([PIXELS[..., ::-1], np.zeros((2, 3, 1), np.uint8)], -1).reshape(2, 12)
    message = image(encoding="bgra8", step=16, data=padded.tobytes())
    np.testing.assert_array_equal(messages.image_from(message), PIXELS)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"data": b"abc"}, "3 bytes in rows of 9 are no 3 by 2 pixels of rgb8"),
        ({"step": 8}, "18 bytes in rows of 8"),
        ({"encoding": "x" * 10**6}, "encoding is 'x{79}…', expected"),
        ({"height": 0, "data": b""}, "3 by 0 pixels"),
        ({"height": 2**31, "width": 2**31, "step": 2**33}, "18 bytes"),
    ],
)
def test_an_image_that_is_none_is_refused(changed: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        messages.image_from(image(**changed))


@pytest.mark.parametrize(("kind", "mode"), [("PNG", "RGBA"), ("JPEG", "RGB")])
def test_a_compressed_image_is_decoded(kind: str, mode: str) -> None:
    data, picture = io.BytesIO(), np.full((40, 30, 3), (200, 100, 50), np.uint8)
    Image.fromarray(picture).convert(mode).save(data, kind)
    message = SimpleNamespace(format="rgb8; jpeg compressed bgr8", data=np.frombuffer(data.getvalue(), np.uint8))
    found = messages.image_from(message)
    assert found.shape == (40, 30, 3) and np.abs(found.astype(int) - picture).max() <= 2


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"",
        lambda whole: whole[:-40],
        lambda whole: b"GIF89a" + whole,
        # Cut short.
        lambda whole: whole[:33] + b"\0\0\0\3pHYs\0\0\1" + crc32(b"pHYs\0\0\1").to_bytes(4, "big") + whole[33:],
    ],
)
def test_a_compressed_image_that_is_none_is_refused(damage: Any) -> None:
    data, depth = io.BytesIO(), io.BytesIO()
    Image.fromarray(np.zeros((4, 5), np.uint16)).save(depth, "PNG")
    with pytest.raises(ValueError, match=r"the image is 4 x 5 pixels of I;16"):
        messages.image_from(SimpleNamespace(format="16UC1; compressedDepth", data=depth.getvalue()))
    Image.fromarray(PIXELS.repeat(30, 0).repeat(30, 1)).save(data, "PNG")
    with pytest.raises(ValueError, match="the image cannot be decoded"):
        messages.image_from(SimpleNamespace(format="png", data=damage(data.getvalue())))


def test_fingers_may_come_in_messages_of_their_own_with_further_joints() -> None:
    states = messages.JointStates(ROBOT)
    arm = SimpleNamespace(name=["two", "one"], position=[2.0, 1.0], velocity=[])
    fingers = SimpleNamespace(name=["left", "right", "knuckle"], position=[0.02, 0.01, 0.5], velocity=[])
    with pytest.raises(ValueError, match=r"joint state lacks left, right, .* it has two, one"):
        states.read(arm, 0.0)
    assert states.read(fingers, 1.0) is None
    found = states.read(arm, 1.4) or pytest.fail("it has the arm")
    assert found.joints.tolist() == [1.0, 2.0] and found.opening == pytest.approx(0.03)
    with pytest.raises(ValueError, match="lacks left, right"):
        states.read(arm, 1.6)  # the fingers are silent
    assert states.read(joints(), 2.0) is not None


def test_a_hinge_that_closes_at_a_larger_angle_gives_the_opening_and_is_commanded_by_it() -> None:
    limits = replace(ROBOT, finger_open=[0.0, 0.1], finger_closed=[0.8, -0.7], widest=0.085)
    for share, left, right in ((1.0, 0.0, 0.1), (0.25, 0.6, -0.5), (0.0, 0.8, -0.7)):
        measured = messages.JointStates(limits).read(joints(position=[left, 2.0, 9.0, 1.0, right]), 0.0)
        assert measured is not None and measured.opening == pytest.approx(0.085 * share)
        command = Command(np.zeros(2), np.zeros(2), share)
        assert commands.finger_positions(limits, command) == pytest.approx([left, right])
        names = ["one", "two", "left", "right"]
        assert messages.command_from(names, [0.1, 0.2, left, right], limits)[1] == pytest.approx(share)
    incomplete: Any
    for incomplete in ({"widest": None}, {"finger_open": [0.0]}, {"finger_open": [0.0, -0.7]}):
        with pytest.raises(ValueError, match=r"^deploy\.robot\.fingers need, in finger_open and finger_closed, "):
            replace(limits, **incomplete)


def test_joints_are_found_by_name() -> None:
    """Without a velocity they are at rest, and further joints do not matter."""
    states = messages.JointStates(ROBOT)
    found = states.read(joints(), 7.0) or pytest.fail("it has the arm")
    assert (found.stamp, found.opening) == (7.0, pytest.approx(0.04))
    assert (found.joints.tolist(), found.velocities.tolist()) == ([1.0, 2.0], [0.1, 0.2])
    for unknown in ([], [float("nan")] * 5):
        assert states.read(joints(velocity=unknown), 0.0).velocities.tolist() == [0.0, 0.0]  # type: ignore[union-attr]
    others = joints(name=["one", "two", "left", "right", "wheel"], position=[1.0, 2.0, 0.01, 0.02, float("nan")])
    assert states.read(others, 0.0).joints.tolist() == [1.0, 2.0]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"name": ["left", "two", "elsewhere", "three", "right"]}, "lacks one, .* it has left, two"),
        ({"name": ["left", "two", "one", "one", "right"]}, "twice"),
        ({"position": [1.0]}, "5 names, 1 positions"),
        ({"velocity": [1.0]}, "1 velocities"),
        ({"position": [0.03, float("nan"), 9.0, 1.0, 0.01]}, "not finite"),
        ({"position": [0.03, 2.0, 9.0, 1e308, 0.01]}, "has one at 1e\\+308 rad, where this arm cannot be"),
    ],
)
def test_joint_states_that_do_not_fit_are_refused(changed: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        messages.JointStates(ROBOT).read(joints(**changed), 0.0)


def test_a_command_is_read_by_name() -> None:
    names = ["one", "two", "left", "right"]
    position, opening = messages.command_from(names, [0.1, 0.2, 0.02, 0.02], ROBOT)
    assert position.tolist() == [0.1, 0.2] and opening == pytest.approx(0.5)


@pytest.mark.parametrize(
    "wrong", [{"name": ["one"], "position": [0.0]}, {"name": ["one", "two"], "position": [0.0, float("inf")]}]
)
def test_a_command_that_does_not_fit_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="joint command"):
        messages.command_from(wrong["name"], wrong["position"], ROBOT)


def test_a_trajectory_is_timed_and_ends_at_rest() -> None:
    ahead = [Command(np.full(2, 0.1 * n), np.full(2, 0.5), 1.0) for n in range(1, 61)]
    message = commands.trajectory(ROBOT, ahead, 0.02)
    times = [point.time_from_start.sec + point.time_from_start.nanosec * 1e-9 for point in message.points]
    assert times == pytest.approx(0.02 * np.arange(1, 61))
    assert message.joint_names == ["one", "two"]
    assert [*message.points[0].velocities] == [0.5, 0.5] and [*message.points[-1].velocities] == [0.0, 0.0]
