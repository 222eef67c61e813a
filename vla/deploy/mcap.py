"""Demonstrations as ROS 2 bags in MCAP, written without a ROS installation.

Shapes: H by W pixels, J joints, D action components.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vla.data.episodes import EpisodeStore
from vla.data.export import Folders
from vla.data.index import Entry
from vla.deploy.governor import Robot
from vla.deploy.ros2 import Topics
from vla.spec import Array, Spec
from vla.types import Count, Text

SECOND = 1_000_000_000  # [ns]


class Mcap(Folders):
    """One bag per episode, which `rerun`, Foxglove and `ros2 bag` open, and `python -m vla.deploy.bag play` plays.

        episode_00000/episode_00000.mcap   the messages
        episode_00000/metadata.yaml        what ROS wants to know of a bag
        episode_00000/manifest.json        what the numbers mean, and how the episode came about

    Images are rgb8, depths 16UC1 [mm], 0 where there is no return; joint states carry the fingers, as on the robot; the
    instruction comes once, at the start; actions are float32 arrays of D components. Time starts at 1 s.

    Args:
        folder: where to write.
        topics: names of the topics of images, joint states and the instruction, as those of a deployed policy.
        robot: what the joints are called.
        depths: camera → topic of its depth.
        action: topic of the actions to imitate.
        executed: topic of the actions that were executed.
        workers: processes; null: one per core. The files do not depend on it.

    Raises:
        ValueError: `rosbags` is not installed.
    """

    def __init__(
        self,
        folder: Text | Path,
        topics: Topics,
        robot: Robot,
        depths: dict[str, str],
        action: str,
        executed: str,
        workers: Count | None = None,
    ) -> None:
        super().__init__(folder, workers)
        self._topics, self._robot, self._depths = topics, robot, depths
        self._action, self._executed = action, executed
        try:
            _types()
        except ImportError as error:
            raise ValueError("export=mcap needs the package rosbags: pip install 'vla[ros]' or rosbags") from error

    def export(self, store: EpisodeStore) -> Path:
        """Write the bags that are not there yet, each whole or not at all; returns the folder.

        Raises:
            ValueError: a camera has no topic, the robot has another number of joints, or as for other formats.
        """
        self._require_fit(store.spec)
        return super().export(store)

    def settings(self) -> dict[str, Any]:
        """Topics and names of joints."""
        actions = {"action": self._action, "executed": self._executed}
        joints = {"joints": self._robot.joints, "fingers": self._robot.fingers}
        return {"topics": {**asdict(self._topics), "depths": self._depths, **actions}, **joints}

    def write(self, folder: Path, spec: Spec, entry: Entry, rows: dict[str, Array]) -> None:
        """Write one bag."""
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        types = _types()
        with writer:
            connections: dict[str, Any] = {}
            for step in range(entry.steps):
                stamp = SECOND + round(step * SECOND / spec.control_hz)
                for topic, message in self._messages(spec, entry, rows, step, stamp):
                    kind = message.__msgtype__
                    if topic not in connections:
                        connections[topic] = writer.add_connection(topic, kind, typestore=types)
                    writer.write(connections[topic], stamp, types.serialize_cdr(message, kind))

    def _require_fit(self, spec: Spec) -> None:
        for what, topics in (("topics.images", self._topics.images), ("depths", self._depths)):
            missing = [camera for camera in spec.cameras if camera not in topics]
            if missing:
                raise ValueError(f"export.{what} has no topic for {', '.join(missing)}: it has {', '.join(topics)}")
        if len(self._robot.joints) != len(spec.joints):
            raise ValueError(
                f"export.robot has {len(self._robot.joints)} joints, the episodes {len(spec.joints)}: "
                "choose another export.robot"
            )

    def _messages(
        self, spec: Spec, entry: Entry, rows: dict[str, Array], step: int, stamp: int
    ) -> Iterator[tuple[str, Any]]:
        """Topic and message of all there is to say at a step, `stamp` [ns]."""
        if step == 0:
            yield self._topics.instruction, _make("std_msgs/msg/String", data=entry.instruction)
        for camera in spec.cameras:
            header = _header(stamp, f"{camera}_camera_optical_frame")
            yield self._topics.images[camera], _image(header, rows[f"rgb_{camera}"][step], "rgb8")
            yield self._depths[camera], _image(header, rows[f"depth_{camera}"][step], "16UC1")
        yield self._topics.joint_states, self._joint_state(stamp, rows, step)
        for topic, field in ((self._action, "action"), (self._executed, "executed")):
            yield topic, _action(rows[field][step], spec)

    def _joint_state(self, stamp: int, rows: dict[str, Array], step: int) -> Any:
        fingers = len(self._robot.fingers)
        opening = [float(rows["gripper"][step, 0]) / max(fingers, 1)] * fingers
        return _make(
            "sensor_msgs/msg/JointState",
            header=_header(stamp, ""),
            name=[*self._robot.joints, *self._robot.fingers],
            position=np.array([*rows["joints"][step], *opening], float),
            velocity=np.array([*rows["velocities"][step], *[0.0] * fingers], float),
            effort=np.empty(0),
        )


@cache
def _types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _make(kind: str, **fields: Any) -> Any:
    make: Callable[..., Any] = _types().types[kind]
    return make(**fields)


def _header(stamp: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp, SECOND)
    time = _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def _image(header: Any, image: Array, encoding: str) -> Any:
    """A sensor_msgs/Image of an (H, W, …) array, little-endian."""
    rows = image.reshape(len(image), -1).view("uint8")
    return _make(
        "sensor_msgs/msg/Image",
        header=header,
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def _action(action: Array, spec: Spec) -> Any:
    """A std_msgs/Float32MultiArray of (D,) components, labelled with their names."""
    size = len(action)
    dimension = _make("std_msgs/msg/MultiArrayDimension", label=" ".join(spec.action), size=size, stride=size)
    layout = _make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
    return _make("std_msgs/msg/Float32MultiArray", layout=layout, data=action)
