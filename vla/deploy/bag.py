"""Record what goes over the topics as a rosbag2 folder, and play one back.

    python -m vla.deploy.bag record FOLDER      until interrupted; `rerun FOLDER/*.mcap` shows it
    python -m vla.deploy.bag play FOLDER        images, joint states and words as they came, for an agent to act on

What else is in a bag, commands to an arm above all, is not played unless it is named.
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

from vla.deploy.messages import cut
from vla.deploy.overhear import Eavesdropper, message_class
from vla.deploy.ros import NETWORKS, Network, plain_errors, ros, spin
from vla.documents import read_yaml

# What an agent hears, of conf/deploy/topics/isaac.yaml.
HEARD = ("/isaac/camera/image_raw", "/isaac/wrist_camera/image_raw", "/isaac/franka/joint_states", "/user/command")
LARGEST_MEMORY = 2 << 30  # that playing may take [bytes] …
LARGEST_FILE = 8 << 30  # … and of a file, when a bag is compressed as a whole [bytes]


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
        ValueError: there is no bag in the folder, it is damaged, or a topic is not in the bag.
    """
    published = 0
    with opened(folder) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        classes = {connection.topic: message_class(connection.msgtype) for connection in connections}
        if missing := ", ".join(topic for topic in topics if classes.get(topic) is None):
            there = ", ".join(sorted({connection.topic for connection in reader.connections})) or "nothing"
            raise ValueError(f"{folder} has no {missing} to play, it has {cut(there, 500)}: name topics by --topics")
        publishers = {topic: node.create_publisher(kind, topic, 10) for topic, kind in classes.items()}
        give_up = time.monotonic() + 2.0  # somebody may need a moment to find these publishers
        while time.monotonic() < give_up and not all(p.get_subscription_count() for p in publishers.values()):
            stopped.wait(0.02)
        begin, start, end = time.monotonic(), reader.start_time, reader.end_time
        for topic, stamp, raw in _messages(reader, connections, folder):
            if not start <= stamp <= end:
                raise ValueError(f"{folder} is damaged: it has a message from outside the time that it covers")
            with _damage(folder):
                message = _stamped_now(node, raw, classes[topic])
            stopped.wait(max(0.0, begin + (stamp - start) * 1e-9 / speed - time.monotonic()))
            if stopped.is_set():
                break
            publishers[topic].publish(message)
            published += 1
    return published


@contextmanager
def opened(folder: Path) -> Iterator[Any]:
    """A reader of the bag in a folder.

    Raises:
        ValueError: there is no bag in the folder, or it is damaged.
    """
    from rosbags.rosbag2 import Reader

    description = folder / "metadata.yaml"
    if not description.is_file():
        raise ValueError(f"{folder} is no bag: there is no {description}")
    read_yaml(description, dict[str, Any])  # rosbags looks neither at its size nor at its depth
    with _damage(folder):
        reader = Reader(folder)
        reader.open()
    try:
        yield reader
    finally:
        reader.close()


def _messages(reader: Any, connections: Sequence[Any], folder: Path) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time [ns] and bytes of every message of some connections."""
    messages = reader.messages(connections)
    while True:
        with _damage(folder):
            message = next(messages, None)
        if message is None:
            return
        connection, stamp, raw = message
        yield connection.topic, stamp, raw


@contextmanager
def _damage(folder: Path) -> Iterator[None]:
    """What rosbags and ROS raise when they read, which is anything, means that the bag is damaged."""
    try:
        yield
    except Exception as error:
        why = cut(" ".join(str(error).split()), 200) or type(error).__name__
        raise ValueError(f"{folder} is damaged or no bag: {why}") from error


def _stamped_now(node: Any, message: bytes, kind: Any) -> Any:
    """The message as if it were made now: an agent rightly refuses to act on an old one."""
    from rclpy.serialization import deserialize_message

    made = deserialize_message(bytes(message), kind)
    if hasattr(made, "header"):
        made.header.stamp = node.get_clock().now().to_msg()
    return made


def _limit_memory() -> None:
    """A small file can say that it holds any number of bytes."""
    for limit, most in ((resource.RLIMIT_DATA, LARGEST_MEMORY), (resource.RLIMIT_FSIZE, LARGEST_FILE)):
        _, hard = resource.getrlimit(limit)
        resource.setrlimit(limit, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def main() -> None:
    """Record or play."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.bag", description=__doc__.splitlines()[0])
    parser.add_argument("do", choices=("record", "play"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    parser.add_argument("--speed", type=float, default=1.0, help="of playing, against how it was recorded")
    parser.add_argument("--topics", nargs="+", help="what to play", default=HEARD)
    options = parser.parse_args()
    if not 0 < options.speed < math.inf:
        parser.error("--speed must be above 0")
    with plain_errors(), ros(Network.named(options.network)) as stopped:
        import rclpy

        node = rclpy.create_node("vla_bag")
        if options.do == "play":
            _limit_memory()
            print(f"{play(node, options.folder, options.topics, stopped, options.speed)} messages")
        else:
            recorder = Recorder(node, options.folder)
            spin(node, stopped)
            recorder.close()
            print(f"{recorder.messages} messages in {options.folder}")
        node.destroy_node()


if __name__ == "__main__":
    main()
