"""Record what goes over the topics as a rosbag2 folder, and play one back.

    python -m vla.deploy.bag record FOLDER      until interrupted; `rerun FOLDER/*.mcap` shows it
    python -m vla.deploy.bag play FOLDER        images, joint states and words as they came, for an agent to act on

What else is in a bag, commands to an arm above all, is not played unless it is named.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Collection
from pathlib import Path
from threading import Event
from typing import Any

from vla.deploy.overhear import Eavesdropper, message_class
from vla.deploy.ros import NETWORKS, Network, ros, spin

# What an agent hears, of conf/deploy/topics/isaac.yaml.
HEARD = ("/isaac/camera/image_raw", "/isaac/wrist_camera/image_raw", "/isaac/franka/joint_states", "/user/command")


class Recorder(Eavesdropper):
    """Writes every message on every topic, as it came, into a bag; ends with `close`."""

    raw = True

    def __init__(self, node: Any, folder: Path) -> None:
        """Args: the node whose spinning records; the folder of the bag, which must not exist.

        Raises:
            ValueError: the folder exists.
        """
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        if folder.exists():
            raise ValueError(f"there already is a {folder}: name a folder that does not exist")
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self.messages = 0
        super().__init__(node)

    def hearer(self, topic: str, kind: str) -> Callable[[bytes], None]:
        """Write the messages of a topic."""
        connection = self._writer.add_connection(topic, kind, typestore=self._types)

        def write(message: bytes) -> None:
            self._writer.write(connection, time.time_ns(), message)
            self.messages += 1

        return write

    def close(self) -> None:
        """Finish the bag."""
        super().close()
        self._writer.close()


def play(node: Any, folder: Path, topics: Collection[str], stopped: Event, speed: float = 1.0) -> int:
    """Publish the messages of a bag on some topics at the times they came; the number of messages.

    Raises:
        ValueError: there is no bag in the folder, or a topic is not in the bag.
    """
    from rosbags.rosbag2 import Reader, ReaderError

    published = 0
    try:
        reader = Reader(folder)
        reader.open()
    except ReaderError as error:
        raise ValueError(f"{folder} is no bag: {error}") from error
    try:
        classes = {c.topic: message_class(c.msgtype) for c in reader.connections if c.topic in topics}
        if missing := ", ".join(topic for topic in topics if topic not in classes):
            there = ", ".join(sorted({c.topic for c in reader.connections})) or "nothing"
            raise ValueError(f"{folder} has no {missing}, it has {there}: name what to play by --topics")
        publishers = {t: node.create_publisher(kind, t, 10) for t, kind in classes.items() if kind is not None}
        give_up = time.monotonic() + 2.0  # somebody may need a moment to find these publishers
        while time.monotonic() < give_up and not all(p.get_subscription_count() for p in publishers.values()):
            stopped.wait(0.02)
        begin = time.monotonic()
        for connection, stamp, message in reader.messages():
            if connection.topic not in publishers or stopped.is_set():
                continue
            stopped.wait(max(0.0, begin + (stamp - reader.start_time) * 1e-9 / speed - time.monotonic()))
            publishers[connection.topic].publish(_stamped_now(node, message, classes[connection.topic]))
            published += 1
    finally:
        reader.close()
    return published


def _stamped_now(node: Any, message: bytes, kind: Any) -> Any:
    """The message as if it were made now: an agent rightly refuses to act on an old one."""
    from rclpy.serialization import deserialize_message

    made = deserialize_message(bytes(message), kind)
    if hasattr(made, "header"):
        made.header.stamp = node.get_clock().now().to_msg()
    return made


def main() -> None:
    """Record or play."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.bag", description=__doc__.splitlines()[0])
    parser.add_argument("do", choices=("record", "play"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    parser.add_argument("--speed", type=float, default=1.0, help="of playing, against how it was recorded")
    parser.add_argument("--topics", nargs="+", help="what to play", default=HEARD)
    options = parser.parse_args()
    try:
        with ros(Network.named(options.network)) as stopped:
            import rclpy

            node = rclpy.create_node("vla_bag")
            if options.do == "play":
                print(f"{play(node, options.folder, options.topics, stopped, options.speed)} messages")
            else:
                recorder = Recorder(node, options.folder)
                spin(node, stopped)
                recorder.close()
                print(f"{recorder.messages} messages in {options.folder}")
            node.destroy_node()
    except ValueError as error:
        parser.exit(1, f"error: {error}\n")


if __name__ == "__main__":
    main()
