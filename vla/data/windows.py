"""Training windows: a few frames of history and the actions that follow, gathered in whole batches.

Nothing is decoded and nothing copied ahead of time: a batch is one gather per field from the memory-mapped rows of
the episode store, made by one thread while the model works on the batch before. Which windows a batch holds depends
on the seed and the number of the step alone, so a resumed run sees exactly what an uninterrupted one would have.
"""

# B batch, T history frames, k action chunk, D action components, S truth scalars

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from queue import Empty, SimpleQueue
from sys import getrefcount
from threading import Thread
from typing import Annotated, Any

import numpy as np
import torch
from lightning import LightningDataModule

from vla.data.episodes import EpisodeStore, Rows
from vla.spec import Array, Spec

Batch = dict[str, Any]

# Of a field → of its tensor: torch computes little with uint16.
TYPES = {np.dtype(np.uint8): torch.uint8, np.dtype(np.uint16): torch.int32, np.dtype(np.float32): torch.float32}
NUMPY = {torch.uint8: np.uint8, torch.int32: np.int32, torch.float32: np.float32}

# An action was disturbed where another was executed instead: off by more than this part of it, and of its range.
PART, OF_RANGE = 0.6, 0.05

# Multiplying by the golden ratio spreads consecutive seeds evenly over the circle of 32-bit numbers (Knuth, The Art of
# Computer Programming 3, section 6.4): every stretch of seeds gets its share of held-out episodes.
GOLDEN = 2654435769


def disturbed(action: Array, executed: Array, spec: Spec) -> Array:
    """(N,) bool: whether something else than the (N, D) labels was executed, more than noise in proportion to them.

    What the expert did from then on answers what nobody could foresee.
    """
    least = OF_RANGE * (np.array(spec.high) - np.array(spec.low))
    off: Array = (np.abs(executed - action) > np.maximum(PART * np.abs(action), least)).any(1)
    return off


def held_out(seed: int, fraction: float) -> bool:
    """Whether the episode of `seed` is kept for validation, whatever other episodes there are."""
    return seed * GOLDEN % 2**32 < fraction * 2**32


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
    """

    def __init__(self, store: EpisodeStore, history: int, chunk: int, depth: bool = False, pin: bool = False) -> None:
        self._pin, self._memory = pin, Memory()
        self._ages, self._aheads = np.arange(1 - history, 1), np.arange(chunk)
        kinds = ("rgb", "depth") if depth else ("rgb",)
        self._images = {kind: {name: store.rows(f"{kind}_{name}") for name in store.spec.cameras} for kind in kinds}
        # One array, because looking rows up costs more than copying so few numbers.
        names = ("joints", "velocities", "gripper", *(("truth",) if store.spec.truth else ()))
        self._numbers = np.concatenate([store.rows(name)[:] for name in names], axis=1)
        self._truth_size = store.spec.truth_size
        self._action = store.rows("action")
        off = disturbed(self._action[:], store.rows("executed")[:], store.spec)
        self._disturbances = np.append(0, off.cumsum())  # before each row
        entries = store.episodes
        self._instructions = [entry.instruction for entry in entries]
        self._first = np.array([entry.start for entry in entries])
        self._last = np.array([entry.start + entry.steps - 1 for entry in entries])

    def __call__(self, windows: Array) -> Batch:
        """The batch of `windows` (B,), row numbers.

        A frame before the start of the episode is all zeros, not present, and has no valid label. A label is not valid
        either if a step between its frame and itself was disturbed, or if it lies beyond the end, where it repeats the
        last action. So the valid labels of a frame come first.
        """
        episode = self._first.searchsorted(windows, side="right") - 1  # (B,)
        first, last = self._first[episode, None], self._last[episode, None]
        frames = windows[:, None] + self._ages  # (B, T)
        labels = frames[:, :, None] + self._aheads  # (B, T, k)
        present = frames >= first
        valid = (labels <= last[:, :, None]) & present[:, :, None]
        labels = np.minimum(np.maximum(labels, first[:, :, None]), last[:, :, None])
        frames = np.maximum(frames, first)
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


class Stream:
    """Batches of `gather` for the windows that `plan` names, made by one thread a few batches ahead."""

    def __init__(self, gather: Callable[[Array], Batch], plan: Callable[[], Iterable[Array]], ahead: int) -> None:
        self._gather, self._plan, self._ahead = gather, plan, ahead

    def __iter__(self) -> Iterator[Batch]:
        wanted: SimpleQueue[Array | None] = SimpleQueue()
        made: SimpleQueue[Batch | Exception] = SimpleQueue()

        def make() -> None:
            while (windows := wanted.get()) is not None:
                try:
                    made.put(self._gather(windows))
                except Exception as error:  # is raised where the batch is waited for
                    made.put(error)

        Thread(target=make, name="windows", daemon=True).start()
        under_way = 0
        try:
            for windows in self._plan():
                wanted.put(windows)
                under_way += 1
                if under_way > self._ahead:
                    yield _result(made)
                    under_way -= 1
            for _ in range(under_way):
                yield _result(made)
        finally:
            with suppress(Empty):
                while True:
                    wanted.get_nowait()
            wanted.put(None)


class CountedStream(Stream):
    """A stream that ends, and knows after how many batches."""

    def __init__(self, gather: Callable[[Array], Batch], batches: list[Array], ahead: int) -> None:
        super().__init__(gather, lambda: batches, ahead)
        self._length = len(batches)

    def __len__(self) -> int:
        return self._length


class Windows(LightningDataModule):
    """The windows of an episode store, split by episode and shared out among the processes of a trainer.

    Training is an endless stream (bound it with the trainer's `max_steps`); validation is one pass over windows spread
    evenly over the held-out episodes, in whole batches.

    Args:
        folder: the episode store.
        spec: what the model expects of a step.
        history: frames T in a window.
        chunk: actions k that label a frame.
        seed: of the order of training windows.
        batch_size: windows B in a batch, per process.
        validation_fraction: share of the episodes held out, 0…1; 0 trains on all of them and does not validate.
        validation_windows: about how many held-out windows one validation looks at, over all processes.
        depth: whether batches carry depth.
        ahead: batches made ahead of the model.
        episodes: use only the first so many episodes; all of them when None.
    """

    def __init__(
        self,
        folder: str | Path,
        spec: Spec,
        history: int,
        chunk: int,
        seed: int,
        batch_size: Annotated[int, 1],
        validation_fraction: float,
        validation_windows: Annotated[int, 1],
        depth: bool,
        ahead: Annotated[int, 0],
        episodes: int | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= validation_fraction < 1:
            raise ValueError(f"data.validation_fraction is a share from 0 up to 1, not {validation_fraction}")
        self.batch_size = batch_size
        self._folder, self._spec, self._episodes = Path(folder), spec, episodes
        self._history, self._chunk, self._depth = history, chunk, depth
        self._seed, self._ahead = seed, ahead
        self._fraction, self._validation_windows = validation_fraction, validation_windows

    def setup(self, stage: str | None = None) -> None:
        """Open the store and split its episodes.

        Raises:
            ValueError: the store cannot be read, has another spec, or too few episodes to split.
        """
        store = EpisodeStore(self._folder, self._episodes)
        self._spec.require(store.spec, "the model", f"the episode store {self._folder}")
        sides: dict[bool, list[Array]] = {False: [], True: []}
        for entry in store.episodes:
            sides[held_out(entry.seed, self._fraction)].append(np.arange(entry.start, entry.start + entry.steps))
        if not sides[False] or (self._fraction > 0 and not sides[True]):
            raise ValueError(
                f"{len(store.episodes)} episodes leave {len(sides[False])} for training and {len(sides[True])} for "
                f"validation: raise collect.episodes, or set data.validation_fraction (now {self._fraction})"
            )
        self.training_windows = np.concatenate(sides[False])  # row numbers
        self.held_out_windows = np.concatenate(sides[True]) if sides[True] else np.empty(0, np.int64)
        self.gather = Gather(store, self._history, self._chunk, self._depth, self._on_gpu())

    def train_dataloader(self) -> Stream:
        """Batches without end, from the trainer's current step on."""
        return Stream(self.gather, self._training_plan, self._ahead)

    def val_dataloader(self) -> CountedStream | list[Batch]:
        """The same batches every time."""
        if not len(self.held_out_windows):
            return []
        rank, processes = self._place()
        share = self.batch_size * processes
        batches = max(1, min(self._validation_windows, len(self.held_out_windows)) // share)
        # Whole batches, so that a compiled model sees one shape and all processes take the same number of steps.
        spread = np.linspace(0, len(self.held_out_windows) - 1, batches * share).round().astype(np.int64)
        windows = self.held_out_windows[spread].reshape(batches, self.batch_size, processes)
        return CountedStream(self.gather, list(windows[:, :, rank]), self._ahead)

    def order(self, step: int, rank: int = 0, processes: int = 1) -> Array:
        """The windows (B,) of training step `step` in process `rank`: row numbers.

        The order is one shuffle of all windows after the other, dealt out in runs of B.
        """
        first = (step * processes + rank) * self.batch_size
        count = len(self.training_windows)
        shuffle, place = np.divmod(np.arange(first, first + self.batch_size), count)
        numbers = range(shuffle[0], shuffle[-1] + 1)
        chosen = [_shuffled(count, self._seed, number)[place[shuffle == number]] for number in numbers]
        return self.training_windows[np.concatenate(chosen)]

    def _training_plan(self) -> Iterator[Array]:
        rank, processes = self._place()
        step = self.trainer.global_step * self.trainer.accumulate_grad_batches if self.trainer else 0
        while True:
            yield self.order(step, rank, processes)
            step += 1

    def _place(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _on_gpu(self) -> bool:
        return self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"


@lru_cache(maxsize=2)
def _shuffled(count: int, seed: int, number: int) -> Array:
    return np.random.default_rng([seed, number]).permutation(count)


def _result(made: SimpleQueue[Batch | Exception]) -> Batch:
    batch = made.get()
    if isinstance(batch, Exception):
        raise batch
    return batch
