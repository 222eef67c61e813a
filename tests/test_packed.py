"""A packed store stands in for the one it was made of, and damage in it is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exporting import exporter
from toy import ARM_SPEC, make_environment, make_expert
from toy_episodes import CONFIG, EPISODES, add, content

from vla.data.episodes import EpisodeStore
from vla.data.verification import derive_store, require_whole, verify_store
from vla.data.window_batches import WindowBatcher
from vla.parallel.pool import LocalCluster
from vla.rollouts.collect import collect


def packed(tmp_path: Path, *overrides: str) -> EpisodeStore:
    """The episodes of `test_episodes`, packed by this process."""
    return EpisodeStore(exporter("packed", tmp_path / "packed", *overrides).export(add(tmp_path / "store", EPISODES)))


def same(one: Any, other: Any) -> bool:
    """Whether two batches are equal, bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else bool(one == other)


def test_without_loss_batches_and_episodes_are_the_same_bit_for_bit(tmp_path: Path) -> None:
    small, whole = packed(tmp_path), EpisodeStore(tmp_path / "store")
    assert small.tried == whole.tried and small.config == whole.config
    rows = np.arange(len(whole.rows("action")))
    for history in (1, 6):
        assert same(
            WindowBatcher(small, history, 2, depth=True)(rows), WindowBatcher(whole, history, 2, depth=True)(rows)
        )
    for entry in whole.episodes:
        expected = whole.read(entry)
        for field, values in small.read(entry).items():
            np.testing.assert_array_equal(values, expected[field])
    assert content(small.folder)["index.jsonl"] == content(whole.folder)["index.jsonl"]


def test_jpeg_is_close_and_depth_exact(tmp_path: Path) -> None:
    small, whole = packed(tmp_path, "export.codec=jpeg", "export.quality=95"), EpisodeStore(tmp_path / "store")
    require_whole(verify_store(small))
    for entry, source in zip(small.episodes, whole.episodes, strict=True):
        rows, expected = small.read(entry), whole.read(source)
        np.testing.assert_array_equal(rows["depth_wrist"], expected["depth_wrist"])
        difference = rows["rgb_front"].astype(float) - expected["rgb_front"]
        assert 0 < np.abs(difference).mean() < 12
    with pytest.raises(ValueError, match="holds JPEG, which must not"):
        exporter("packed", tmp_path / "again").export(small)
    derive_store([small], tmp_path / "merged")
    assert EpisodeStore(tmp_path / "merged").derived  # it is not what one collection would have made


def test_a_packed_store_is_looked_into_and_put_together_like_any(tmp_path: Path) -> None:
    small = packed(tmp_path)
    found = verify_store(small)
    require_whole(found)
    assert found.sizes["rgb_front"] == (small.folder / "rgb_front.pack").stat().st_size
    derive_store([small], tmp_path / "unpacked")
    assert content(tmp_path / "unpacked") == content(tmp_path / "store")


def test_it_does_not_grow(tmp_path: Path) -> None:
    packed(tmp_path)
    store = EpisodeStore.create_or_open(tmp_path / "packed", ARM_SPEC, CONFIG)
    assert collect(store, make_environment, make_expert, 4, LocalCluster(1), seed=0).added == 0
    with pytest.raises(ValueError, match=r"packed is packed and does not grow: set collect\.episodes=4"):
        collect(store, make_environment, make_expert, 5, LocalCluster(1), seed=0)


@pytest.mark.parametrize("codec", ["lossless", "jpeg"])
def test_damage_is_named_by_seed(tmp_path: Path, codec: str) -> None:
    store = packed(tmp_path, f"export.codec={codec}")
    path = store.folder / "rgb_wrist.pack"
    data = bytearray(path.read_bytes())
    begins = int(np.fromfile(store.folder / "rgb_wrist.offsets", "<u8")[store.tried[1].start])
    data[begins : begins + 8] = b"#" * 8
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"the rows of seed 1 in .*packed were changed on disk"):
        store.read(store.tried[1])
    with pytest.raises(ValueError, match=r"the rows of seed 1 in .*packed were changed on disk"):
        WindowBatcher(store, 1, 1)(np.array([0, store.tried[1].start]))
    assert store.read(store.tried[0]) and verify_store(store).damaged == {"rows changed or lost": [1]}
    path.write_bytes(data[:-1])
    with pytest.raises(ValueError, match=r"rgb_wrist\.pack is shorter than its index says"):
        EpisodeStore(store.folder)
    assert verify_store(EpisodeStore(store.folder, damaged=True)).damaged == {"rows changed or lost": [1, 4]}


def test_only_what_the_store_shows_is_packed_once(tmp_path: Path) -> None:
    whole = add(tmp_path / "store", EPISODES)
    shown = EpisodeStore(whole.folder, episodes=2)
    folder = exporter("packed", tmp_path / "few").export(shown)
    assert EpisodeStore(folder).tried == whole.tried[:2]
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    exporter("packed", tmp_path / "few").export(shown)
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    with pytest.raises(ValueError, match=r"few has content other than these episodes: choose another export"):
        exporter("packed", tmp_path / "few").export(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["few", "store"]


def test_stores_that_cannot_be_packed_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no episodes yet"):
        exporter("packed", tmp_path / "new").export(add(tmp_path / "empty", []))
    with pytest.raises(ValueError, match=r"export\.quality must be a whole number, at least 1, at most 95, got 100"):
        exporter("packed", tmp_path / "new", "export.quality=100")
