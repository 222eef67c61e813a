"""No change on disk, in whatever file of a store, is trained on."""

from __future__ import annotations

import string
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from toy import ARM_SPEC
from toy_episodes import CODECS, CONFIG, EPISODES, add

from vla.data.datamodule import WindowDataModule
from vla.data.episodes import EpisodeStore
from vla.data.header import Codec


def train(folder: Path) -> None:
    """What a training does with a store before and while it learns from every step."""
    store = EpisodeStore.create_or_open(folder, ARM_SPEC, CONFIG)
    assert len(store.statistics.actions)
    windows = WindowDataModule(folder, ARM_SPEC, 1, 1, 0, 8, 0, 8, ahead=0)
    windows.setup()
    for first in range(0, len(windows.training_windows), 8):
        windows.make_batch(windows.training_windows[first : first + 8])


def put(path: Path, place: int, value: int) -> None:
    """Change one byte where it is: the file may be mapped into memory."""
    with path.open("r+b") as file:
        file.seek(place)
        file.write(bytes([value]))


def flip(data: bytes, place: int) -> int:
    return data[place] ^ 1 << place % 8


def respell(data: bytes, place: int) -> int:
    """Another digit for a digit, another letter for a letter."""
    for alphabet in (string.digits, string.ascii_lowercase, string.ascii_uppercase):
        if (found := alphabet.find(chr(data[place]))) >= 0:
            return ord(alphabet[(found + 1 + place % (len(alphabet) - 1)) % len(alphabet)])
    return data[place]


@pytest.mark.parametrize(
    ("codec", "suffixes", "change", "count"),
    [
        (CODECS[0], (".json", ".jsonl", ".bin"), flip, 90),
        (CODECS[1], (".pack", ".ends"), flip, 30),
        (CODECS[2], (".pack", ".ends"), flip, 30),
        (CODECS[0], (".jsonl",), respell, 60),
    ],
    ids=["raw", "lossless", "jpeg", "index"],
)
def test_no_change_is_trained_on(
    tmp_path: Path, codec: Codec, suffixes: tuple[str, ...], change: Callable[[bytes, int], int], count: int
) -> None:
    """Each of so many changes of one byte, in files chosen at random, ends a training by name."""
    folder = add(tmp_path / "store", EPISODES, codec).folder
    trained = [path for path in folder.iterdir() if path.suffix in suffixes and not path.name.startswith("depth")]
    names, random = sorted(path.name for path in trained), np.random.default_rng(0)
    for _ in range(count):
        path = folder / str(random.choice(names))
        whole = path.read_bytes()
        place = int(random.integers(len(whole)))
        while (value := change(whole, place)) == whole[place]:
            place = (place + 1) % len(whole)
        put(path, place, value)
        with pytest.raises(ValueError, match=folder.name):
            train(folder)
        put(path, place, whole[place])
    train(folder)
