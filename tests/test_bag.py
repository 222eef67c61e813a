"""Bags that anybody may have written or that a disk has damaged: played, or refused in one sentence."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from vla.deploy.bag import play

TYPES = get_typestore(Stores.ROS2_JAZZY)


def written(folder: Path, compressed: bool) -> Path:
    """A bag with five joint states and five words in 0.4 s."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        header = TYPES.types["std_msgs/msg/Header"](TYPES.types["builtin_interfaces/msg/Time"](1, 2), "base")
        numbers = np.arange(9.0)
        names = [f"panda_joint{number}" for number in range(9)]
        state = TYPES.types["sensor_msgs/msg/JointState"](header, names, numbers, numbers, np.empty(0))
        for topic, message in (("/joint_states", state), ("/words", TYPES.types["std_msgs/msg/String"]("go on"))):
            connection = writer.add_connection(topic, message.__msgtype__, typestore=TYPES)
            for step in range(5):
                data = TYPES.serialize_cdr(message, message.__msgtype__)
                writer.write(connection, 10**9 + step * 10**8, data)
    return folder


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "compressed"])
def bag(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """A whole bag."""
    return written(tmp_path_factory.mktemp("bags") / "bag", request.param)


def played(folder: Path) -> list[Any]:
    """What is published of a bag."""
    heard: list[Any] = []
    publisher = SimpleNamespace(publish=heard.append, get_subscription_count=lambda: 1)
    clock = SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time))
    node = SimpleNamespace(create_publisher=lambda *arguments: publisher, get_clock=lambda: clock)
    assert play(node, folder, ["/joint_states", "/words"], Event(), speed=1e9) == len(heard)
    return heard


def test_a_whole_bag_is_played_in_order(bag: Path) -> None:
    heard = played(bag)
    assert len(heard) == 10 and sum(hasattr(message, "data") for message in heard) == 5
    assert {message.data for message in heard if hasattr(message, "data")} == {"go on"}


def test_a_topic_of_an_unknown_type_is_named(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla.deploy.bag.message_class", lambda name: None if "String" in name else object)
    with pytest.raises(ValueError, match=r"bag: the messages of /words are of a type that"):
        played(bag)


@pytest.mark.parametrize("name", ["bag.mcap", "metadata.yaml"])
def test_a_damaged_bag_is_played_or_refused_in_a_sentence(bag: Path, tmp_path: Path, name: str) -> None:
    """Bits that flip in many places, ends that are missing, sizes that are huge."""
    whole, generator = (bag / name).read_bytes(), random.Random(0)
    refused = 0
    for trial in range(120):
        data, place = bytearray(whole), generator.randrange(len(whole) - 8)
        if trial % 4 == 0:
            del data[place:]
        elif trial % 4 == 1:
            data[place : place + 8] = (1 << generator.randrange(20, 62)).to_bytes(8, "little")
        else:
            data[place] ^= 1 << generator.randrange(8)
        shutil.rmtree(tmp_path / "bag", ignore_errors=True)
        shutil.copytree(bag, tmp_path / "bag")
        (tmp_path / "bag" / name).write_bytes(data)
        try:
            played(tmp_path / "bag")
        except ValueError as error:
            assert str(tmp_path / "bag") in str(error) and "\n" not in str(error) and len(str(error)) < 1000
            refused += 1
    assert refused > 30


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [x]\nb: [*a, *a]", "aliases"),
        (f"a: {'[' * 100_000}", "deeper than"),
        ("#" * (2 << 20), "more than the"),
        ("", "damaged or of another kind"),
        ("rosbag2_bagfile_information: 1", "is damaged or not a bag"),
    ],
    ids=["bomb", "deep", "large", "empty", "number"],
)
def test_a_description_that_is_none_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(ValueError, match=words):
        played(tmp_path)


def test_a_pipe_is_not_played(bag: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(bag, tmp_path / "bag"))
    (folder / "bag.mcap").unlink()
    os.mkfifo(folder / "bag.mcap")
    with pytest.raises(ValueError, match=r"bag\.mcap is a folder, a pipe or a device, not a file"):
        played(folder)


def test_where_no_bag_is_that_is_said(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match=r"is not a bag: it has no metadata\.yaml"):
            played(folder)
