"""Data module of training windows: a history of frames and a chunk of the actions that follow.

A batch is one gather per field from the memory-mapped rows of the episode store, made by one thread while the model
works on earlier batches. Its windows depend on the seed and the step number alone, also when a run is resumed.
"""

# B batch, T history frames, k action chunk, D action components, S truth scalars

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from lightning import LightningDataModule
from torch import Tensor

from vla.data.episodes import EpisodeStore
from vla.data.index import Entry, recording_of
from vla.data.window_batches import Batch, WindowBatcher, concatenate_batches
from vla.io.errors import UserError, counted
from vla.io.types import Count, Natural, Rate, Seed
from vla.spec import Array, Spec

# Multiplying by the golden ratio spreads consecutive seeds evenly over the circle of 32-bit numbers (Knuth, The Art of
# Computer Programming 3, section 6.4): every stretch of seeds gets its share of held-out episodes.
GOLDEN_RATIO = 2654435769


def is_held_out(recording: int, fraction: float) -> bool:
    """Return whether an episode is held out for validation, independently of others, by its `recording_of`."""
    return recording * GOLDEN_RATIO % 2**32 < fraction * 2**32


def digest_of(episodes: Sequence[Entry]) -> str:
    """Return a digest of the content of episodes."""
    entries = repr([(entry.seed, entry.steps, entry.crc) for entry in episodes])
    return hashlib.sha256(entries.encode()).hexdigest()[:12]


def require_trainable(spec: Spec, stores: Iterable[EpisodeStore]) -> None:
    """Raise a UserError unless the stores have what a model with this spec is trained on; they may lack its truth."""
    for store in stores:
        name = f"the episode store {store.folder}"
        spec.require_input(store.spec, "the model", name)
        if store.spec.truth:
            replace(store.spec, truth=spec.truth).require(store.spec, "the model", name)


class Prefetcher:
    """Iterable of batches, made by one background thread.

    Args:
        make_batch: windows (B,) → batch.
        plan: returns the windows of every batch, in order.
        ahead: number of batches made in advance.
        batches: their number; None: endless.

    Attributes:
        waited: total time that the consumer waited for batches [s].
    """

    def __init__(
        self,
        make_batch: Callable[[Array], Batch],
        plan: Callable[[], Iterable[Array]],
        ahead: int,
        batches: int | None = None,
    ) -> None:
        self._make_batch, self._plan, self._ahead, self._batches = make_batch, plan, ahead, batches
        self.waited = 0.0

    def __len__(self) -> int:
        if self._batches is None:
            raise TypeError("endless")
        return self._batches

    def __iter__(self) -> Iterator[Batch]:
        maker = ThreadPoolExecutor(1, "windows")  # unlike a daemon thread, joined at exit
        futures: deque[Future[Batch]] = deque()
        try:
            for windows in self._plan():
                futures.append(maker.submit(self._make_batch, windows))
                if len(futures) > self._ahead:
                    yield self._wait_for(futures.popleft())
            while futures:
                yield self._wait_for(futures.popleft())
        finally:
            maker.shutdown(wait=False, cancel_futures=True)

    def _wait_for(self, future: Future[Batch]) -> Batch:
        start = time.perf_counter()
        batch = future.result()
        self.waited += time.perf_counter() - start
        return batch


class WindowDataModule(LightningDataModule):
    """Windows of episode stores, split by episode and divided among the processes of a trainer.

    Training batches are endless (bounded by the trainer's `max_steps`); validation is one pass over windows spaced
    evenly over the held-out episodes, in whole batches.

    Args:
        folder: the episode store.
        spec: layout of a step that the model expects; images of another size are cropped and resized to its own.
        history: frames T in a window.
        chunk: actions k that label a frame.
        seed: of the order of training windows.
        batch_size: windows B in a batch, per process.
        validation_fraction: share of the episodes held out, 0…1; 0 trains on all of them and does not validate.
        validation_windows: approximate number of held-out windows per validation, over all processes.
        ahead: batches made in advance.
        tokenize: sentences → tensor, added to batches as `text`; None adds nothing.
        episodes: number of episodes to use, the first ones; None: all.
        more: further episode stores, all of whose episodes are used; they may lack the simulator's truth.
    """

    def __init__(
        self,
        folder: str | Path,
        spec: Spec,
        history: int,
        chunk: int,
        seed: Seed,
        batch_size: Count,
        validation_fraction: Rate,
        validation_windows: Count,
        ahead: Natural,
        tokenize: Callable[[list[str]], Tensor] | None = None,
        episodes: Count | None = None,
        more: Sequence[str | Path] = (),
    ) -> None:
        super().__init__()
        self.batch_size = batch_size
        self._folder, self._spec, self._episodes, self._further_folders = Path(folder), spec, episodes, more
        self._history, self._chunk = history, chunk
        self._seed, self.ahead, self._tokenize = seed, ahead, tokenize
        self._fraction, self._validation_windows = validation_fraction, validation_windows

    def setup(self, stage: str | None = None) -> None:
        """Open the stores and split their episodes; a UserError if they do not match the spec, or are too few."""
        stores = [EpisodeStore(self._folder, self._episodes), *map(EpisodeStore, self._further_folders)]
        counts = [store.episodes[-1].end if store.episodes else 0 for store in stores]
        self._starts = np.cumsum([0, *counts[:-1]])
        training, holdout = list[Array](), list[Array]()
        require_trainable(self._spec, stores)
        for store, offset in zip(stores, self._starts, strict=True):
            for entry in store.episodes:
                windows = holdout if is_held_out(recording_of(entry), self._fraction) else training
                windows.append(offset + np.arange(entry.start, entry.end))
        episodes = [entry for store in stores for entry in store.episodes]
        if not training or (self._fraction > 0 and not holdout):
            raise UserError(
                f"of {counted(len(episodes), 'episode')} {len(training)} would train, {len(holdout)} validate: raise "
                f"collect.episodes, or set data.validation_fraction (now {self._fraction})"
            )
        self._digest = digest_of(episodes)
        self.training_windows = np.concatenate(training)  # row numbers
        self.held_out_windows = np.concatenate([np.empty(0, np.int64), *holdout])
        layout = self._history, self._chunk, self._on_gpu(), self._spec
        self._batchers = [WindowBatcher(store, *layout) for store in stores]

    def make_batch(self, windows: Array) -> Batch:
        """Return the batch of `windows` (B,), row numbers counted over all stores; its windows are sorted by store.

        Its tokenized instructions are in page-locked memory if a GPU is to read them. Raises as `WindowBatcher` does.
        """
        store = self._starts.searchsorted(windows, side="right") - 1
        numbers = np.unique(store).tolist()
        parts = [self._batchers[number](windows[store == number] - self._starts[number]) for number in numbers]
        batch = parts[0] if len(parts) == 1 else concatenate_batches(parts)
        if self._tokenize is not None:
            text = self._tokenize(batch["instruction"])
            batch["text"] = text.pin_memory() if self._on_gpu() else text
        return batch

    def verify(self) -> None:
        """Raise a UserError if images differ from their checksums; otherwise an episode is verified when first read."""
        for batcher in self._batchers:
            batcher.verify()

    def state_dict(self) -> dict[str, Any]:
        """Return a digest of the demonstrations and the size of a batch over all processes, saved with checkpoints."""
        return {"windows": self._digest, "batch": self.batch_size * self._place()[1]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Raise a UserError unless demonstrations and batches are those of the resumed training."""
        before, batch, processes = state["batch"], self.batch_size * self._place()[1], self._place()[1]
        if before != batch:
            raise UserError(
                f"the resumed training had batches of {before} windows, and {counted(processes, 'process')} would have "
                f"batches of {batch}: train on as many devices as before"
            )
        if state["windows"] != self._digest:
            raise UserError(
                f"the resumed training was started with other demonstrations than those in {self._folder}: "
                "put the earlier ones back there, or start a new training in another output=DIR, without resume="
            )

    def train_dataloader(self) -> Prefetcher:
        """Return endless batches, from the trainer's current step on."""
        return Prefetcher(self.make_batch, self._training_plan, self.ahead)

    def val_dataloader(self) -> Prefetcher | list[Batch]:
        """Return the validation batches, the same every time."""
        if not len(self.held_out_windows):
            return []
        rank, processes = self._place()
        global_batch = self.batch_size * processes
        batches = max(1, min(self._validation_windows, len(self.held_out_windows)) // global_batch)
        # Whole batches: one shape for a compiled model, and the same number of steps in all processes. Each is spread
        # over all episodes: where stores lack the truth, batches of such windows alone would count as losses of 0.
        indices = np.linspace(0, len(self.held_out_windows) - 1, batches * global_batch).round().astype(np.int64)
        windows = self.held_out_windows[indices].reshape(self.batch_size, batches, processes)
        return Prefetcher(self.make_batch, lambda: windows[:, :, rank].T, self.ahead, batches)

    def order(self, step: int, rank: int = 0, processes: int = 1) -> Array:
        """Return the windows (B,) of training step `step` in process `rank`, as row numbers.

        The order is a sequence of permutations of all windows, divided into batches.
        """
        start = (step * processes + rank) * self.batch_size
        count = len(self.training_windows)
        shuffle, place = np.divmod(np.arange(start, start + self.batch_size), count)
        numbers = range(shuffle[0], shuffle[-1] + 1)
        indices = [_permutation(count, self._seed, number)[place[shuffle == number]] for number in numbers]
        return self.training_windows[np.concatenate(indices)]

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
def _permutation(count: int, seed: Seed, number: int) -> Array:
    return np.random.default_rng([seed, number]).permutation(count)
