"""Demonstrations as ROS 2 bags in MCAP, written without a ROS installation.

Shapes: H by W pixels, J joints, D action components.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vla.data.episodes import EpisodeStore
from vla.data.formats.files import Files
from vla.data.index import Entry
from vla.deploy.bag import message_types
from vla.deploy.joint_limiter import Robot
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.io.types import Text
from vla.parallel.pool import THIS_PROCESS, Cluster
from vla.robots.controllers import joint_factors
from vla.spec import Array, Spec

SECOND = 1_000_000_000  # [ns]


class Mcap(Files):
    """One bag per episode, which `rerun`, Foxglove and `ros2 bag` open, and `python -m vla.deploy.bag play` plays.

        episode_00000/episode_00000.mcap   the messages
        episode_00000/metadata.yaml        the description that ROS requires
        episode_00000/manifest.json        units and names, seed and draws of the episode

    Images are rgb8, depths 16UC1 [mm] with 0 for no return. Joint states include the fingers, as on the robot. The
    instruction is sent once, at the start. Actions are float32 arrays of D components. Time starts at 1 s.

    Args:
        folder: output folder.
        topics: topics of images, joint states and the instruction, as for a deployed policy.
        robot: joint names of the arm.
        depths: camera → topic of its depth images.
        action: topic of the expert's actions, the labels for imitation.
        executed: topic of the actions that were executed.

    Raises:
        UserError: `rosbags` is not installed.
    """

    def __init__(
        self,
        folder: Text | Path,
        topics: Topics,
        robot: Robot,
        depths: dict[str, str],
        action: str,
        executed: str,
    ) -> None:
        super().__init__(folder)
        self._topics, self._robot, self._depths = topics, robot, depths
        self._action, self._executed = action, executed
        try:
            message_types()
        except ImportError as error:
            raise UserError("export=mcap needs the package rosbags: pip install 'vla[ros]' or rosbags") from error

    def export(self, store: EpisodeStore, cluster: Cluster = THIS_PROCESS) -> Path:
        """Write the missing bags, each one atomically; returns the folder.

        Raises:
            UserError: the episodes have no robot or one with another number of joints, a camera has no topic, or the
                base class refuses the folder.
        """
        self._require_fit(store.spec)
        return super().export(store, cluster)

    def _manifest(self, store: EpisodeStore, number: int) -> dict[str, Any]:
        actions = {"action": self._action, "executed": self._executed}
        topics = {**asdict(self._topics), "depths": self._depths, **actions}
        joints = {"joints": self._robot.joints, "fingers": self._robot.fingers}
        return super()._manifest(store, number) | {"topics": topics, **joints}

    def write(self, folder: Path, spec: Spec, entry: Entry, rows: dict[str, Array]) -> None:
        """Write one bag."""
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        types = message_types()
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
        robot = spec.require_robot("export=mcap")
        joint_factors(spec)  # raises an error before anything is written
        images, depths = (spec.cameras, self._topics.images), (spec.depth, self._depths)
        for key, (cameras, topics) in {"topics.images": images, "depths": depths}.items():
            if missing := [camera for camera in cameras if camera not in topics]:
                raise UserError(f"export.{key} has no topic for {', '.join(missing)}: it has {', '.join(topics)}")
        if len(self._robot.joints) != len(robot.joints):
            raise UserError(
                f"export.robot has {len(self._robot.joints)} joints, the episodes {len(robot.joints)}: "
                "choose another export.robot"
            )

    def _messages(
        self, spec: Spec, entry: Entry, rows: dict[str, Array], step: int, stamp: int
    ) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of everything published at a step, `stamp` [ns]."""
        if step == 0:
            yield self._topics.instruction, _make("std_msgs/msg/String", data=entry.instruction)
        for camera in spec.cameras:
            header = _header(stamp, f"{camera}_camera_optical_frame")
            yield self._topics.images[camera], _image(header, rows[f"rgb_{camera}"][step], "rgb8")
            if camera in spec.depth:
                yield self._depths[camera], _image(header, rows[f"depth_{camera}"][step], "16UC1")
        yield self._topics.joint_states, self._joint_state(stamp, spec, rows["state"][step])
        for topic, field in ((self._action, "action"), (self._executed, "executed")):
            yield topic, _action(rows[field][step], spec)

    def _joint_state(self, stamp: int, spec: Spec, state: Array) -> Any:
        robot = spec.require_robot("export=mcap")
        joints, velocities = (state[spec.indices(names)] for names in (robot.joints, robot.velocities))
        joints, velocities = joints * joint_factors(spec), velocities * joint_factors(spec, velocities=True)
        fingers = self._robot.fingers if robot.gripper else []
        opening = (
            [float(state[spec.indices([robot.gripper])[0]]) / len(fingers) for _ in fingers] if robot.gripper else []
        )
        return _make(
            "sensor_msgs/msg/JointState",
            header=_header(stamp, ""),
            name=[*self._robot.joints, *fingers],
            position=np.array([*joints, *opening], float),
            velocity=np.array([*velocities, *[0.0] * len(fingers)] if len(velocities) else [], float),
            effort=np.empty(0),
        )


def _make(kind: str, **fields: Any) -> Any:
    make: Callable[..., Any] = message_types().types[kind]
    return make(**fields)


def _header(stamp: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp, SECOND)
    time = _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def _image(header: Any, image: Array, encoding: str) -> Any:
    """Return a sensor_msgs/Image of an (H, W, …) array, little-endian."""
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
    """Return a std_msgs/Float32MultiArray of (D,) components, labelled with their names."""
    size = len(action)
    dimension = _make("std_msgs/msg/MultiArrayDimension", label=" ".join(spec.action), size=size, stride=size)
    layout = _make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
    return _make("std_msgs/msg/Float32MultiArray", layout=layout, data=action)
