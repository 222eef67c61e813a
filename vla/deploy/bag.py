"""Record all topics of standard messages as a rosbag2 folder, and play a bag back.

    python -m vla.deploy.bag record FOLDER      until interrupted; `rerun FOLDER/*.mcap` shows it
    python -m vla.deploy.bag play FOLDER        images, joint states and instructions at their original times

Other topics of a bag, in particular commands to an arm, are played only if named by --topics.
"""

from __future__ import annotations

import argparse
import math
import resource
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from threading import Event
from typing import Any

from vla.deploy.messages import shorten
from vla.deploy.ros import NETWORKS, command_node, spin
from vla.deploy.topic_listener import TopicListener, message_class
from vla.io.documents import read_yaml
from vla.io.errors import UserError
from vla.io.files import require_file

# The inputs of a policy in conf/deploy/topics/isaac.yaml.
POLICY_INPUTS = (
    "/isaac/camera/image_raw",
    "/isaac/wrist_camera/image_raw",
    "/isaac/franka/joint_states",
    "/user/command",
)
RESERVE = 256 << 20  # space on a disk that is left to finish a bag [bytes]
MAX_MEMORY = 2 << 30  # for reading a bag, beyond what the process has [bytes]
MAX_FILE_SIZE = 8 << 30  # of a file that is decompressed to disk [bytes]


class BagRecorder(TopicListener):
    """Writes the messages of every topic to a bag until `close`."""

    raw = True

    def __init__(self, node: Any, folder: Path) -> None:
        """Args: the node that subscribes, which the caller spins; the folder of the bag, which must not exist.

        Raises:
            UserError: the folder exists.
        """
        from rosbags.rosbag2 import StoragePlugin, Writer

        if folder.exists():
            raise UserError(f"{folder} exists already: choose another folder")
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self.messages = 0
        super().__init__(node)

    def callback_for(self, topic: str, kind: str) -> Callable[[bytes], None]:
        """Return a callback that writes the messages of a topic."""
        connection = self._writer.add_connection(topic, kind, typestore=message_types())

        def write(message: bytes) -> None:
            if shutil.disk_usage(self._folder).free < RESERVE:
                raise UserError(f"{self._folder} ends here: the disk has less than {RESERVE >> 20} MiB left")
            self._writer.write(connection, time.time_ns(), message)
            self.messages += 1

        return write

    def close(self) -> None:
        """Finish the bag."""
        super().close()
        self._writer.close()


def play(node: Any, folder: Path, topics: Collection[str], stopped: Event, speed: float = 1.0) -> int:
    """Publish the messages of some topics of a bag at their original times; returns the number of messages.

    Raises:
        UserError: the folder is not a bag, it is damaged, or it lacks a topic.
    """
    published = 0
    with opened(folder) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        classes = {connection.topic: message_class(connection.msgtype) for connection in connections}
        if missing := ", ".join(topic for topic in topics if topic not in classes):
            there = ", ".join(sorted({connection.topic for connection in reader.connections})) or "nothing"
            raise UserError(
                f"{folder} has no topic {missing}, it has {shorten(there, 500)}: choose topics with --topics"
            )
        if unknown := ", ".join(each.topic for each in connections if classes[each.topic] is None):
            raise UserError(f"{folder}: the messages of {unknown} are of a type that this machine does not have")
        publishers = {topic: node.create_publisher(kind, topic, 10) for topic, kind in classes.items()}
        deadline = time.monotonic() + 2.0  # for the discovery of these publishers
        while time.monotonic() < deadline and not all(p.get_subscription_count() for p in publishers.values()):
            stopped.wait(0.02)
        begin, start, end = time.monotonic(), reader.start_time, reader.end_time
        for topic, stamp, raw in messages_of(reader, connections, folder):
            if not start <= stamp <= end:
                raise UserError(f"{folder} is damaged: a message lies outside its time range")
            stopped.wait(max(0.0, begin + (stamp - start) * 1e-9 / speed - time.monotonic()))
            if stopped.is_set():
                break
            with bag_errors(folder):
                message = _stamped_now(node, raw, classes[topic])
            publishers[topic].publish(message)
            published += 1
    return published


@cache
def message_types() -> Any:
    """Return the message types of ROS 2 Jazzy, as `rosbags` knows them."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def opened(folder: Path) -> Iterator[Any]:
    """Open a reader of the bag in a folder; within the context, memory and the size of files are limited.

    Raises:
        UserError: the folder is not a bag, or it is damaged.
    """
    from rosbags.rosbag2 import Reader

    description = folder / "metadata.yaml"
    if not description.is_file():
        raise UserError(f"{folder} is not a bag: it has no {description.name}")
    read_yaml(description, dict[str, Any])  # rosbags limits neither its size nor its depth
    for path in folder.iterdir():
        require_file(path)
    with _limits():
        with bag_errors(folder):
            reader = Reader(folder)
            reader.open()
        try:
            yield reader
        finally:
            reader.close()


def messages_of(
    reader: Any, connections: Sequence[Any], folder: Path, start: int | None = None, stop: int | None = None
) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, time [ns] and bytes of every message of some connections, from `start` to before `stop` [ns]."""
    messages = reader.messages(connections, start, stop)
    while True:
        with bag_errors(folder):
            message = next(messages, None)
        if message is None:
            return
        connection, stamp, raw = message
        yield connection.topic, stamp, raw


@contextmanager
def bag_errors(folder: Path) -> Iterator[None]:
    """Convert exceptions of rosbags and ROS, which can be of any type, into a UserError that names the bag."""
    try:
        yield
    except MemoryError as error:
        raise UserError(f"{folder} needs more than {MAX_MEMORY >> 30} GiB of memory once it is unpacked") from error
    except Exception as error:
        why = shorten(" ".join(str(error).split()), 200) or type(error).__name__
        raise UserError(f"{folder} is damaged or not a bag: {why}") from error


def _stamped_now(node: Any, message: bytes, kind: Any) -> Any:
    """Deserialise a message and set its time stamp to now: an agent refuses to act on old messages."""
    from rclpy.serialization import deserialize_message

    decoded = deserialize_message(bytes(message), kind)
    if hasattr(decoded, "header"):
        decoded.header.stamp = node.get_clock().now().to_msg()
    return decoded


@contextmanager
def _limits() -> Iterator[None]:
    """Limit memory and the size of files: a small compressed bag can unpack to any size."""
    statm = Path("/proc/self/statm")  # pages; the sixth number is the data segment and the stack
    used = int(statm.read_text().split()[5]) * resource.getpagesize() if statm.is_file() else 0
    most = {resource.RLIMIT_DATA: used + MAX_MEMORY, resource.RLIMIT_FSIZE: MAX_FILE_SIZE}
    before = {limit: resource.getrlimit(limit) for limit in most}
    for limit, size in most.items():
        resource.setrlimit(
            limit, (min([size, *(each for each in before[limit] if each != resource.RLIM_INFINITY)]), before[limit][1])
        )
    try:
        yield
    finally:
        for limit, sizes in before.items():
            resource.setrlimit(limit, sizes)


def main() -> None:
    """Record or play."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.bag", description=__doc__.splitlines()[0])
    parser.add_argument("do", choices=("record", "play"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    parser.add_argument("--speed", type=float, default=1.0, help="playback speed, 1 is that of the recording")
    parser.add_argument("--topics", nargs="+", help="topics to play", default=POLICY_INPUTS)
    options = parser.parse_args()
    if not 0 < options.speed < math.inf:
        parser.error("--speed must be above 0")
    with command_node("vla_bag", options.network) as (node, stopped):
        if options.do == "play":
            print(f"{play(node, options.folder, options.topics, stopped, options.speed)} messages")
        else:
            with closing(BagRecorder(node, options.folder)) as recorder:
                spin(node, stopped)
            print(f"{recorder.messages} messages in {options.folder}")


if __name__ == "__main__":
    main()
