"""Batches of training windows, copied from the rows of an episode store in one gather per field.

Shapes: B batch, T history frames, k action chunk, D action components, S truth scalars.
"""

from __future__ import annotations

from collections.abc import Sequence
from sys import getrefcount
from typing import Any

import numpy as np
import torch

from vla.data.episodes import EpisodeStore
from vla.data.fields import Rows
from vla.io.images import fit_images
from vla.spec import Array, Spec

Batch = dict[str, Any]

# An executed action is perturbed if it differs from the label by more than this share of the label, and of the range.
SHARE_OF_LABEL, SHARE_OF_RANGE = 0.6, 0.05


def is_perturbed(action: Array, executed: Array, spec: Spec) -> Array:
    """Return (N,) bool: the executed action differs from the (N, D) label by more than proportional noise.

    Later labels react to a perturbation that a policy cannot predict, so the loss masks them.
    """
    tolerance = SHARE_OF_RANGE * (np.array(spec.high) - np.array(spec.low))
    deviations = np.abs(executed - action) > np.maximum(SHARE_OF_LABEL * np.abs(action), tolerance)
    return np.any(deviations, axis=1)


class BufferPool:
    """Pool of arrays that are reused once no array, view or tensor refers to them.

    Reuse saves the zeroing of new memory by the kernel, which takes longer than the copy itself. The pool grows to the
    largest number of arrays in use at once; a shorter array is the start of a longer one.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[Any, ...], list[Array]] = {}

    def empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Array:
        """Return an array with arbitrary content.

        Torch aligns it to a cache line; NumPy does not, which halves the speed of copies on some processors.
        """
        length, *rest = shape
        arrays = self._arrays.setdefault((*rest, dtype), [])
        for array in arrays:
            # References of the list, of `array` and of the argument; another thread at this line adds a fourth.
            if len(array) >= length and getrefcount(array) == 3:
                return array[:length]
        arrays.append(torch.empty(shape, dtype=dtype).numpy())
        return arrays[-1][:]


class WindowBatcher:
    """Callable that copies windows of an episode store into batches; a window is identified by its newest row.

    The numeric rows of the store are verified on construction; a UserError if they differ from their checksums.

    Args:
        store: source of the rows.
        history: frames T in a window.
        chunk: actions k that label a frame.
        pin: allocate page-locked memory, from which copies to a GPU are asynchronous.
        spec: of the batches, None: of the store. Images of another size are cropped at the centre and resized, and
            truth that the store lacks is NaN.
    """

    def __init__(
        self, store: EpisodeStore, history: int, chunk: int, pin: bool = False, spec: Spec | None = None
    ) -> None:
        self._pin, self._buffers = pin, BufferPool()
        self._frame_offsets, self._label_offsets = np.arange(1 - history, 1), np.arange(chunk)
        self._images = {camera: store.rows(f"rgb_{camera}", True) for camera in store.spec.cameras}
        # Two arrays, of frames and of labels: the row look-up costs more than the copy of a few numbers.
        names = ("state", *(("truth",) if store.spec.truth else ()))
        numbers = {name: store.rows(name) for name in (*names, "action", "executed")}
        store.verify(store.episodes, numbers)
        self._size, self._truth_size = (spec or store.spec).image_size, (spec or store.spec).truth_size
        columns = [numbers[name][:] for name in names]
        # NaN in place of truth that other stores have but this one lacks.
        missing_truth = np.full((len(columns[0]), self._truth_size - store.spec.truth_size), np.nan, np.float32)
        self._numbers = np.concatenate([*columns, missing_truth], axis=1)
        label, executed = numbers["action"][:], numbers["executed"][:]
        self._actions, self._action_size = np.concatenate([label, executed], axis=1), label.shape[1]
        perturbed_rows = is_perturbed(label, executed, store.spec)
        self._perturbations = np.append(0, perturbed_rows.cumsum())  # before each row
        self._store, self._entries = store, (entries := store.episodes)
        self._verified = np.zeros(len(entries), bool)  # images only
        self._instructions = [entry.instruction for entry in entries]
        self._first_rows = np.array([entry.start for entry in entries])
        self._last_rows = np.array([entry.end - 1 for entry in entries])

    def __call__(self, windows: Array) -> Batch:
        """Return the batch of `windows` (B,), row numbers (UserError: images of these episodes differ from their
        checksums, which are compared once per episode).

        A frame before the start of the episode is zero, absent, and has no valid label. A label is also invalid if a
        step between its frame and itself was perturbed, or if it lies beyond the end of the episode, where it repeats
        the last action. The valid labels of a frame therefore come first. `perturbations` (B, T, k): perturbed steps
        between a frame and each label, -1 beyond the episode.
        """
        episode = self._first_rows.searchsorted(windows, side="right") - 1  # (B,)
        if not self._verified[episode].all():
            self.verify(np.unique(episode[~self._verified[episode]]))
        first_rows, last_rows = self._first_rows[episode, None], self._last_rows[episode, None]
        frames = windows[:, None] + self._frame_offsets  # (B, T)
        labels = frames[:, :, None] + self._label_offsets  # (B, T, k)
        present = frames >= first_rows
        inside = (labels <= last_rows[:, :, None]) & present[:, :, None]
        labels = np.minimum(np.maximum(labels, first_rows[:, :, None]), last_rows[:, :, None])
        frames = np.maximum(frames, first_rows)
        perturbations = self._perturbations[labels] - self._perturbations[frames][:, :, None]
        absent = None if present.all() else ~present
        images = {name: self._take(rows, frames, absent) for name, rows in self._images.items()}
        batch: Batch = {
            "rgb": {name: self._stage(fit_images(image, self._size, "crop")) for name, image in images.items()}
        }
        numbers = self._take(self._numbers, frames, absent)
        state = self._numbers.shape[1] - self._truth_size
        batch["state"] = self._stage(numbers[..., :state])
        if self._truth_size:
            batch["truth"] = self._stage(numbers[..., state:])
        actions = self._take(self._actions, labels)
        batch["action"] = self._stage(actions[..., : self._action_size])
        batch["executed"] = self._stage(actions[..., self._action_size :])
        batch["present"] = self._stage(torch.from_numpy(present))
        batch["valid"] = self._stage(torch.from_numpy(inside & (perturbations == 0)))
        batch["perturbations"] = self._stage(torch.from_numpy(np.where(inside, perturbations, -1)))
        batch["instruction"] = [self._instructions[number] for number in episode.tolist()]
        return batch

    def verify(self, episodes: Array | None = None) -> None:
        """Raise a UserError if images of the episodes with numbers (N,), by default all, differ from their checksums.

        Otherwise an episode is verified when its first window is read.
        """
        episodes = np.arange(len(self._entries)) if episodes is None else episodes
        entries = [self._entries[number] for number in episodes.tolist()]
        self._store.verify(entries, {f"rgb_{camera}": rows for camera, rows in self._images.items()})
        self._verified[episodes] = True

    def _take(self, rows: Rows, index: Array, absent: Array | None = None) -> torch.Tensor:
        values = self._empty((*index.shape, *rows.shape[1:]), getattr(torch, rows.dtype.name))
        rows.take(index, axis=0, out=values, mode="clip")  # "clip" writes into `out` without a buffer
        if absent is not None:
            values[absent] = 0  # many times faster than in torch
        return torch.from_numpy(values)

    def _empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Array:
        if self._pin:
            return torch.empty(shape, dtype=dtype, pin_memory=True).numpy()
        return self._buffers.empty(shape, dtype)

    def _stage(self, tensor: torch.Tensor) -> torch.Tensor:
        """Return a tensor, for a GPU page-locked and contiguous: a strided one would be copied elsewhere first."""
        return tensor.contiguous().pin_memory() if self._pin else tensor


def concatenate_batches(parts: Sequence[Any]) -> Any:
    """Concatenate batches, that is, mappings of tensors, lists and mappings."""
    sample = parts[0]
    if isinstance(sample, dict):
        return {name: concatenate_batches([part[name] for part in parts]) for name in sample}
    if isinstance(sample, list):
        return [item for part in parts for item in part]
    tensor = torch.cat(list(parts))
    return tensor.pin_memory() if sample.is_pinned() else tensor
