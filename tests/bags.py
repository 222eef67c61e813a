"""Bags of a session with the arm of `arm.py`, written without ROS."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from arm import ROBOT, SPEC
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from vla.robots.cartesian import CartesianController
from vla.robots.panda import HOME, PANDA
from vla.spec import Array

START = 1_700_000_000_000_000_000  # [ns]
TICK = 0.02  # of joint states and commands [s]
TYPES = get_typestore(Stores.ROS2_JAZZY)
IMAGES = {"front": "/front", "wrist": "/wrist"}


def make(kind: str, **fields: Any) -> Any:
    """Build a message."""
    return TYPES.types[kind](**fields)


@dataclass
class Part:
    """Some steps of a session."""

    state: str  # of the agent
    actions: Array  # (N, 7)
    person: bool = False  # moves the arm
    instruction: str | None = None  # sent at the start
    commands: bool = True  # are published
    images: bool = True  # are, too


def moving(steps: int, seed: int, gripper: float = 1.0) -> Array:
    """Actions of a motion (steps, 7)."""
    random = np.random.default_rng(seed)
    direction = random.uniform(-0.004, 0.004, 6) + np.array([0, 0, 0.004, 0, 0, 0.02])
    return np.column_stack([np.repeat(direction[None], steps, 0), np.full(steps, gripper)]).astype(np.float32)


def resting(steps: int = 3, gripper: float = 1.0) -> Array:
    """Actions without a motion (steps, 7)."""
    return np.repeat(np.array([[0, 0, 0, 0, 0, 0, gripper]], np.float32), steps, 0)


SESSION = (
    Part("waiting", resting(4)),
    Part("running", moving(20, 0), instruction="put the red block on the pad"),
    Part("holding", resting()),
    Part("handed over", resting(6), person=True),
    Part("handed over", moving(12, 1, gripper=0.0), person=True),
    Part("handed over", resting(5, gripper=0.0), person=True),
    Part("holding", resting(gripper=0.0)),
    Part("running", moving(10, 2, gripper=0.0)),
    Part("stopped", resting(4, gripper=0.0)),
    Part("running", moving(8, 3), instruction="lift the blue block"),
    Part("stopped", resting()),
)


class Session:
    """Writes a bag: joint states and commands at 50 Hz, images at 10 Hz, whose brightness counts the steps."""

    def __init__(self, writer: Writer, status: bool, compressed: bool) -> None:
        self._writer, self._status, self._compressed = writer, status, compressed
        self._connections: dict[str, Any] = {}
        self._controller = CartesianController(PANDA, 1 / SPEC.control_hz, [-9.0] * 3, [9.0] * 3)
        self._controller.reset(HOME)
        self.joints, self.opening, self.step, self.now = HOME.copy(), 1.0, 0, 0.0

    def send(self, topic: str, message: Any, late: float = 0.0) -> None:
        """Write a message, `late` seconds from now."""
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=TYPES)
        stamp = START + round((self.now + late) * 1e9)
        self._writer.write(self._connections[topic], stamp, TYPES.serialize_cdr(message, kind))

    def play(self, part: Part) -> None:
        """Write a part."""
        if part.instruction is not None:
            self.send("/words", make("std_msgs/msg/String", data=part.instruction))
        if self._status:
            values = {"state": part.state, "handed over": "yes" if part.person else "no"}
            pairs = [make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
            status = {"level": 0, "name": "vla_agent", "message": "", "hardware_id": "", "values": pairs}
            self.send("/vla_agent/status", make("diagnostic_msgs/msg/DiagnosticStatus", **status))
        for action in part.actions:
            if part.images:
                self._images()
            start, end = self.joints, self._controller.step(action[:6]).copy()
            self.opening = float(action[6])
            for tick in range(1, 6):
                self.joints = start + (end - start) * tick / 5
                self.now += TICK
                if part.commands:
                    self.send("/commands", self._joint_state(self.joints))
                self.send("/joint_states", self._joint_state(self.joints))
            self.step += 1

    def _header(self) -> Any:
        seconds, rest = divmod(START + round(self.now * 1e9), 1_000_000_000)
        stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return make("std_msgs/msg/Header", stamp=stamp, frame_id="")

    def _joint_state(self, joints: Array) -> Any:
        fingers = np.array(ROBOT.finger_positions(self.opening))
        position = np.concatenate([fingers, joints])
        names = {"name": [*ROBOT.fingers, *ROBOT.joints], "position": position}
        nothing = {"velocity": np.empty(0), "effort": np.empty(0)}
        return make("sensor_msgs/msg/JointState", header=self._header(), **names, **nothing)

    def _images(self) -> None:
        """Write images that were taken now and arrive 10 ms later."""
        pixels = np.full((8, 8, 3), min(3 * self.step, 255), np.uint8)
        for topic in IMAGES.values():
            if self._compressed:
                data = io.BytesIO()
                Image.fromarray(pixels).save(data, "PNG")
                packed = {"format": "rgb8; png compressed bgr8", "data": np.frombuffer(data.getvalue(), np.uint8)}
                message = make("sensor_msgs/msg/CompressedImage", header=self._header(), **packed)
            else:
                layout = {"height": 8, "width": 8, "encoding": "rgb8", "is_bigendian": 0, "step": 24}
                message = make("sensor_msgs/msg/Image", header=self._header(), **layout, data=pixels.ravel())
            self.send(topic, message, late=0.01)


def write(
    folder: Path,
    parts: Sequence[Part] = SESSION,
    storage: StoragePlugin = StoragePlugin.MCAP,
    status: bool = True,
    compressed: bool = False,
) -> Path:
    """Write the bag of a session."""
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        session = Session(writer, status, compressed)
        for part in parts:
            session.play(part)
    return folder
