"""What batches are gathered into, and which labels are left out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import toy

from vla.data import episodes
from vla.data.episodes import EpisodeStore
from vla.data.fields import Field, ScatteredRows
from vla.data.header import RAW
from vla.data.window_batches import BufferPool, WindowBatcher, is_perturbed
from vla.io.errors import UserError


def test_a_step_is_perturbed_if_the_executed_action_differs_from_the_label_by_more_than_noise() -> None:
    label = np.array([0.04, -0.01, 1.0])
    executed = [
        label,
        label * [1.4, 0.7, 1],
        label + np.array([0, 0.004, 0]),
        [0.0, -0.01, 1.0],
        label * [1, -1, 1],
        [0.04, 0, 0],
    ]
    off = is_perturbed(np.tile(label, (6, 1)), np.array(executed), toy.SPEC)
    assert off.tolist() == [False, False, False, True, True, True]


def test_memory_is_used_again_once_nothing_refers_to_it() -> None:
    memory = BufferPool()
    first = memory.empty((2, 3), torch.uint8)
    tensor = torch.from_numpy(first).view(3, 2)[1:]
    place = first.__array_interface__["data"]
    del first
    assert memory.empty((2, 3), torch.uint8).__array_interface__["data"] != place
    del tensor
    assert memory.empty((2, 3), torch.uint8).__array_interface__["data"] == place


@pytest.mark.parametrize("size", [(16, 16), (8, 12)])
def test_what_a_gpu_reads_is_page_locked_and_without_gaps(
    size: tuple[int, int], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pinned, empty = set[int](), torch.empty

    def allocated(*size: Any, pin_memory: bool = False, **options: Any) -> torch.Tensor:
        made = empty(*size, **options)
        pinned.update([made.data_ptr()] if pin_memory else ())
        return made

    def pin(tensor: torch.Tensor) -> torch.Tensor:
        pinned.add(tensor.data_ptr())
        return tensor

    monkeypatch.setattr(torch, "empty", allocated)
    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    store, spec = EpisodeStore(folder), replace(toy.SPEC, image_size=size)
    batch, plain = (WindowBatcher(store, 2, 3, for_gpu, spec)(np.arange(8)) for for_gpu in (True, False))
    tensors = [name for name, values in plain.items() if isinstance(values, torch.Tensor)]
    pairs = [(batch[name], plain[name]) for name in tensors]
    pairs += [(batch["rgb"][camera], images) for camera, images in plain["rgb"].items()]
    for one, other in pairs:
        assert torch.equal(one, other) and one.is_contiguous() and one.data_ptr() in pinned


@pytest.mark.parametrize("advised", [True, False], ids=["Linux", "macOS"])
def test_rows_in_random_order_are_those_of_the_file(
    advised: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not advised:
        monkeypatch.delattr(os, "posix_fadvise")
    values = np.random.default_rng(0).integers(0, 255, (900, 7, 5, 3), np.uint8)
    values.tofile(tmp_path / "rows.bin")
    damaged: Callable[[int], UserError] = lambda row: UserError(f"row {row}")  # noqa: E731
    rows = ScatteredRows(Field(tmp_path, "rows", (7, 5, 3), values.dtype, RAW), 850, damaged)  # more are being written
    index = np.array([[849, 0], [3, 500]])
    np.testing.assert_array_equal(rows.take(index), values[index])
    out = np.empty((2, 2, 7, 5, 3), np.uint8)
    assert rows.take(index, 0, out, "clip") is out and np.array_equal(out, values[index])
    np.testing.assert_array_equal(rows[840:900], values[840:850])
    assert rows[5:5].shape == (0, 7, 5, 3)
    os.truncate(tmp_path / "rows.bin", 840 * 105)
    with pytest.raises(ValueError, match="row 840"):
        rows.take(np.array([3, 840]))


@pytest.mark.parametrize("history", [1, 3])
def test_batches_of_a_store_that_is_larger_than_the_memory_are_the_same(
    history: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = WindowBatcher(EpisodeStore(folder), history, 2)
    monkeypatch.setattr(episodes, "memory", lambda: 1)
    store = EpisodeStore(folder)
    assert all(
        isinstance(store.rows(f"rgb_{camera}", in_random_order=True), ScatteredRows) for camera in store.spec.cameras
    )
    large = WindowBatcher(store, history, 2)
    large.verify()
    windows = np.random.default_rng(0).integers(0, store.episodes[-1].end, 40)
    for name, images in small(windows)["rgb"].items():
        assert torch.equal(large(windows)["rgb"][name], images) and images.any()
