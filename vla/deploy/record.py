"""Record all topics of standard messages as a rosbag2 folder, until interrupted: python -m vla.deploy.record FOLDER

It is for installations without the command `ros2 bag record`, such as the wheels of ROS.
"""

from __future__ import annotations

import argparse
import shutil
import time
from contextlib import closing
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from vla.deploy.bag import message_types, rosbags
from vla.deploy.messages import shorten
from vla.deploy.ros import NETWORKS, command_node, spin
from vla.io.errors import UserError, counted

DISCOVERY_PERIOD = 0.5  # between two queries for new topics [s]
MESSAGE_PACKAGES = ("sensor_msgs", "std_msgs", "trajectory_msgs", "geometry_msgs", "diagnostic_msgs", "rosgraph_msgs")
RESERVE = 256 << 20  # space on a disk that is left to finish a bag [bytes]


def require_new(folder: Path) -> None:
    """Raise a UserError if the folder of a bag exists already."""
    if folder.exists():
        raise UserError(f"{folder} exists already: choose another folder")


class BagRecorder:
    """Writes the messages of every topic of a standard type to a bag until `close`, also of later topics."""

    def __init__(self, node: Any, folder: Path) -> None:
        """Args: the node that subscribes, which the caller spins; the folder of the bag, which must not exist.

        Raises:
            UserError: the folder exists, or rosbags is not installed.
        """
        bags = rosbags("rosbag2")
        require_new(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._node, self._folder, self.messages = node, folder, 0
        self._writer = bags.Writer(folder, version=9, storage_plugin=bags.StoragePlugin.MCAP)
        self._writer.open()
        self._topics, self._subscriptions = set[str](), list[Any]()
        self._discover()
        self._timer = node.create_timer(DISCOVERY_PERIOD, self._discover)

    def close(self) -> None:
        """Finish the bag."""
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._writer.close()

    def _discover(self) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)  # matches every publisher
        latched = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # also what was published before
        for topic, (kind, *_) in self._node.get_topic_names_and_types():
            package, _, name = kind.partition("/msg/")
            if topic in self._topics or package not in MESSAGE_PACKAGES:
                continue
            self._topics.add(topic)
            if kind not in message_types().fielddefs:  # of another ROS distribution, or a custom type
                self._node.get_logger().warning(f"{shorten(topic)} is not recorded: unknown type {shorten(kind)}")
                continue
            durabilities = [info.qos_profile.durability for info in self._node.get_publishers_info_by_topic(topic)]
            qos = latched if {*durabilities} == {latched.durability} else best_effort
            callback = partial(self._write, self._writer.add_connection(topic, kind, typestore=message_types()))
            message = getattr(import_module(f"{package}.msg"), name)
            self._subscriptions.append(self._node.create_subscription(message, topic, callback, qos, raw=True))

    def _write(self, connection: Any, message: bytes) -> None:
        if shutil.disk_usage(self._folder).free < RESERVE:
            raise UserError(f"{self._folder} ends here: the disk has less than {RESERVE >> 20} MiB left")
        self._writer.write(connection, time.time_ns(), message)
        self.messages += 1


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.record", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of the bag, which must not exist")
    parser.add_argument("--network", choices=NETWORKS, default="loopback", help="deploy.network.reach of the agent")
    options = parser.parse_args()
    with command_node("vla_record", options.network) as (node, stop_event):
        with closing(BagRecorder(node, options.folder)) as recorder:
            spin(node, stop_event)
        print(f"{counted(recorder.messages, 'message')} in {options.folder}")


if __name__ == "__main__":
    main()
