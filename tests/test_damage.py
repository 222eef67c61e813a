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

SKIPPED = ("lock",)


def train(folder: Path) -> None:
    """What a training does with a store before and while it learns from every step."""
    store = EpisodeStore.create_or_open(folder, ARM_SPEC, CONFIG)
    assert len(store.statistics.actions)
    windows = WindowDataModule(
        folder,
        ARM_SPEC,
        history=1,
        chunk=1,
        seed=0,
        batch_size=8,
        validation_fraction=0,
        validation_windows=8,
        depth=True,
        ahead=0,
    )
    windows.setup()
    for first in range(0, len(windows.training_windows), 8):
        windows.make_batch(windows.training_windows[first : first + 8])


def require_named(folder: Path, names: list[str], change: Callable[[bytes, int], int], count: int) -> None:
    """Each of so many changes of one byte, in files chosen at random, ends a training by name."""
    random = np.random.default_rng(0)
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


def test_no_flipped_bit_is_trained_on(tmp_path: Path) -> None:
    add(tmp_path / "store", EPISODES)
    files = sorted(path.name for path in (tmp_path / "store").iterdir() if path.name not in SKIPPED)
    require_named(tmp_path / "store", files, flip, 90)


@pytest.mark.parametrize("codec", CODECS[1:], ids=str)
def test_no_flipped_bit_of_a_compressed_image_is_trained_on(tmp_path: Path, codec: Codec) -> None:
    add(tmp_path / "store", EPISODES, codec)
    files = sorted(path.name for path in (tmp_path / "store").iterdir() if path.suffix in (".pack", ".ends"))
    require_named(tmp_path / "store", files, flip, 30)


def test_no_letter_or_digit_of_an_index_is_trained_on(tmp_path: Path) -> None:
    add(tmp_path / "store", EPISODES)
    require_named(tmp_path / "store", ["index.jsonl"], respell, 60)


def test_all_damaged_episodes_are_named_with_the_way_out(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    path = store.folder / "rgb_wrist.bin"
    image = len(path.read_bytes()) // len(store.rows("action"))
    data = bytearray(path.read_bytes())
    for entry in store.episodes[1:3]:
        data[entry.start * image] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"rows of the seeds 1, 2 in .*store .* job=inspect inspect\.repair=true"):
        windows = WindowDataModule(store.folder, ARM_SPEC, 1, 1, 0, 48, 0, 8, False, 0)
        windows.setup()
        windows.make_batch(windows.training_windows)
