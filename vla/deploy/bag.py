"""Reading rosbag2 folders without ROS."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from vla.deploy.messages import shorten
from vla.io.documents import read_yaml
from vla.io.errors import UserError
from vla.io.files import require_file

DESCRIPTION = "metadata.yaml"  # of a bag


def rosbags(module: str) -> Any:
    """Import a module of the package rosbags; raise a UserError if that is not installed."""
    try:
        return import_module(f"rosbags.{module}")
    except ModuleNotFoundError as error:
        raise UserError("bags need a package that is not installed here: pip install 'rosbags<0.12'") from error


@cache
def message_types() -> Any:
    """Return the message types of ROS 2 Jazzy, as `rosbags` knows them."""
    types = rosbags("typesys")
    return types.get_typestore(types.Stores.ROS2_JAZZY)


@contextmanager
def open_bag(folder: Path) -> Iterator[Any]:
    """Open a reader of the bag in a folder; raise a UserError if it is none, or damaged."""
    make_reader = rosbags("rosbag2").Reader
    if not (folder / DESCRIPTION).is_file():
        raise UserError(f"{folder} is not a bag: it has no {DESCRIPTION}")
    read_yaml(folder / DESCRIPTION, dict[str, Any])  # rosbags limits neither its size nor its depth
    for path in folder.iterdir():
        require_file(path)
    with bag_errors(folder):
        reader = make_reader(folder)
        reader.open()
    with closing(reader):
        yield reader


def messages_of(
    reader: Any, topics: Collection[str | None], folder: Path, start: int | None = None, stop: int | None = None
) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time [ns] and content of every message on some topics, from `start` to before `stop` [ns];
    raise a UserError if the bag is damaged."""
    connections = [connection for connection in reader.connections if connection.topic in topics]
    messages, types = reader.messages(connections, start, stop), message_types()
    while True:
        with bag_errors(folder):
            entry = next(messages, None)
            if entry is None:
                return
            connection, stamp, data = entry
            message = types.deserialize_cdr(data, connection.msgtype)
        yield connection.topic, stamp, message


@contextmanager
def bag_errors(folder: Path) -> Iterator[None]:
    """Convert exceptions of rosbags, which can be of any type, into a UserError that names the bag."""
    try:
        yield
    except Exception as error:
        reason = shorten(" ".join(str(error).split()), 200) or type(error).__name__
        raise UserError(f"{folder} is damaged or not a bag: {reason}") from error
