"""Rows of an episode store as a batch of windows, in one gather per field.

Shapes: B batch, T history frames, k action chunk, D action components, S truth scalars.
"""

from __future__ import annotations

from sys import getrefcount
from typing import Any

import numpy as np
import torch

from vla.data.episodes import EpisodeStore, Rows
from vla.spec import Array, Spec

Batch = dict[str, Any]

# Of a field → of its tensor: torch computes little with uint16.
TYPES = {np.dtype(np.uint8): torch.uint8, np.dtype(np.uint16): torch.int32, np.dtype(np.float32): torch.float32}
NUMPY = {torch.uint8: np.uint8, torch.int32: np.int32, torch.float32: np.float32}

# An action was disturbed where another was executed instead: off by more than this part of it, and of its range.
PART, OF_RANGE = 0.6, 0.05


def disturbed(action: Array, executed: Array, spec: Spec) -> Array:
    """(N,) bool: whether something else than the (N, D) labels was executed, more than noise in proportion to them.

    What the expert did from then on answers what nobody could foresee.
    """
    least = OF_RANGE * (np.array(spec.high) - np.array(spec.low))
    off: Array = (np.abs(executed - action) > np.maximum(PART * np.abs(action), least)).any(1)
    return off


class Memory:
    """Arrays to write into, each used again once nothing else refers to it, not even a view or a tensor of it.

    New memory costs more time than what is written there, because the system fills it with zeros first. There are never
    more arrays than were in use at once.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[tuple[int, ...], type], list[Array]] = {}

    def empty(self, shape: tuple[int, ...], dtype: type) -> Array:
        """An array of any content."""
        arrays = self._arrays.setdefault((shape, dtype), [])
        for array in arrays:
            # By the list, by `array` and by the argument: another thread that looks at it here makes four.
            if getrefcount(array) == 3:
                return array
        arrays.append(np.empty(shape, dtype))
        return arrays[-1]


class Gather:
    """Rows of an episode store as batches of windows; a window is named by the row of its newest frame.

    Args:
        store: where the rows are.
        history: frames T in a window.
        chunk: actions k that label a frame.
        depth: whether batches carry depth.
        pin: whether batches lie in page-locked memory, which a GPU copies from without waiting.

    Raises:
        ValueError: numbers in the store are not those that were written.
    """

    def __init__(self, store: EpisodeStore, history: int, chunk: int, depth: bool = False, pin: bool = False) -> None:
        self._pin, self._memory = pin, Memory()
        self._ages, self._aheads = np.arange(1 - history, 1), np.arange(chunk)
        kinds = ("rgb", "depth") if depth else ("rgb",)
        self._images = {kind: {name: store.rows(f"{kind}_{name}") for name in store.spec.cameras} for kind in kinds}
        # One array, because looking rows up costs more than copying so few numbers.
        names = ("joints", "velocities", "gripper", *(("truth",) if store.spec.truth else ()))
        numbers = {name: store.rows(name) for name in (*names, "action", "executed")}
        store.verify(store.episodes, numbers)
        self._numbers = np.concatenate([numbers[name][:] for name in names], axis=1)
        self._truth_size = store.spec.truth_size
        self._action = numbers["action"]
        off = disturbed(self._action[:], numbers["executed"][:], store.spec)
        self._disturbances = np.append(0, off.cumsum())  # before each row
        self._store, self._entries = store, (entries := store.episodes)
        self._verified = np.zeros(len(entries), bool)  # whose images are
        self._instructions = [entry.instruction for entry in entries]
        self._first = np.array([entry.start for entry in entries])
        self._last = np.array([entry.start + entry.steps - 1 for entry in entries])

    def __call__(self, windows: Array) -> Batch:
        """The batch of `windows` (B,), row numbers.

        A frame before the start of the episode is all zeros, not present, and has no valid label. A label is not valid
        either if a step between its frame and itself was disturbed, or if it lies beyond the end, where it repeats the
        last action. So the valid labels of a frame come first.

        Raises:
            ValueError: images of these episodes are not those that were written; they are checked once.
        """
        episode = self._first.searchsorted(windows, side="right") - 1  # (B,)
        if not self._verified[episode].all():
            self._verify(np.unique(episode[~self._verified[episode]]))
        first, last = self._first[episode, None], self._last[episode, None]
        frames = windows[:, None] + self._ages  # (B, T)
        labels = frames[:, :, None] + self._aheads  # (B, T, k)
        present = frames >= first
        valid = (labels <= last[:, :, None]) & present[:, :, None]
        labels = np.minimum(np.maximum(labels, first[:, :, None]), last[:, :, None])
        frames = np.maximum(frames, first)
        if len(self._aheads) > 1:  # nothing lies between a frame and its own label
            valid &= self._disturbances[labels] == self._disturbances[frames][:, :, None]
        absent = None if present.all() else ~present
        batch: Batch = {
            kind: {camera: self._take(rows, frames, absent) for camera, rows in cameras.items()}
            for kind, cameras in self._images.items()
        }
        numbers = self._take(self._numbers, frames, absent)
        proprio = self._numbers.shape[1] - self._truth_size
        batch["proprio"] = numbers[..., :proprio]
        if self._truth_size:
            batch["truth"] = numbers[..., proprio:]
        batch["action"] = self._take(self._action, labels)
        batch["present"] = self._own(present)
        batch["valid"] = self._own(valid)
        batch["instruction"] = [self._instructions[number] for number in episode.tolist()]
        return batch

    def _verify(self, episodes: Array) -> None:
        entries = [self._entries[number] for number in episodes.tolist()]
        images = {f"{kind}_{camera}": rows for kind, of in self._images.items() for camera, rows in of.items()}
        self._store.verify(entries, images)
        self._verified[episodes] = True

    def _take(self, rows: Rows, index: Array, absent: Array | None = None) -> torch.Tensor:
        values = self._empty((*index.shape, *rows.shape[1:]), TYPES[rows.dtype])
        if values.dtype == rows.dtype:
            rows.take(index, axis=0, out=values, mode="clip")  # "clip" writes into `out` directly
        else:
            values[...] = rows.take(index, axis=0)
        if absent is not None:
            values[absent] = 0  # many times faster than through torch
        return torch.from_numpy(values)

    def _empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Array:
        if self._pin:
            return torch.empty(shape, dtype=dtype, pin_memory=True).numpy()
        return self._memory.empty(shape, NUMPY[dtype])

    def _own(self, values: Array) -> torch.Tensor:
        tensor = torch.from_numpy(values)
        return tensor.pin_memory() if self._pin else tensor
