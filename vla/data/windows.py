"""Training windows: a few frames of history and the actions that follow, gathered in whole batches.

Nothing is decoded and nothing copied ahead of time: a batch is one gather per field from the memory-mapped rows of
the episode store, made by one thread while the model works on the batch before. Which windows a batch holds depends
on the seed and the number of the step alone, so a resumed run sees exactly what an uninterrupted one would have.
"""

# B batch, T history frames, k action chunk, D action components, S truth scalars

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
from lightning import LightningDataModule

from vla.data.episodes import EpisodeStore
from vla.data.gather import Batch, Gather
from vla.spec import Array, Spec
from vla.types import Count, Natural, Rate, Seed

# Multiplying by the golden ratio spreads consecutive seeds evenly over the circle of 32-bit numbers (Knuth, The Art of
# Computer Programming 3, section 6.4): every stretch of seeds gets its share of held-out episodes.
GOLDEN = 2654435769


def held_out(seed: Seed, fraction: float) -> bool:
    """Whether the episode of `seed` is kept for validation, whatever other episodes there are."""
    return seed * GOLDEN % 2**32 < fraction * 2**32


class Stream:
    """Batches of `gather` for the windows that `plan` names, made by one thread a few batches ahead.

    `waited` is how long it was waited for them [s].
    """

    def __init__(self, gather: Callable[[Array], Batch], plan: Callable[[], Iterable[Array]], ahead: int) -> None:
        self._gather, self._plan, self._ahead = gather, plan, ahead
        self.waited = 0.0

    def __iter__(self) -> Iterator[Batch]:
        maker = ThreadPoolExecutor(1, "windows")  # which, unlike a daemon, has ended before the interpreter does
        under_way: deque[Future[Batch]] = deque()
        try:
            for windows in self._plan():
                under_way.append(maker.submit(self._gather, windows))
                if len(under_way) > self._ahead:
                    yield self._wait_for(under_way.popleft())
            while under_way:
                yield self._wait_for(under_way.popleft())
        finally:
            maker.shutdown(wait=False, cancel_futures=True)

    def _wait_for(self, batch: Future[Batch]) -> Batch:
        started = time.perf_counter()
        made = batch.result()
        self.waited += time.perf_counter() - started
        return made


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
        seed: Seed,
        batch_size: Count,
        validation_fraction: Rate,
        validation_windows: Count,
        depth: bool,
        ahead: Natural,
        episodes: Count | None = None,
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
        entries = repr([(entry.seed, entry.steps, entry.crc) for entry in store.episodes])
        self._digest = hashlib.sha256(entries.encode()).hexdigest()[:12]
        self.training_windows = np.concatenate(sides[False])  # row numbers
        self.held_out_windows = np.concatenate(sides[True]) if sides[True] else np.empty(0, np.int64)
        self.gather = Gather(store, self._history, self._chunk, self._depth, self._on_gpu())

    def state_dict(self) -> dict[str, str]:
        """What tells the demonstrations of a training from others; saved with its checkpoints."""
        return {"windows": self._digest}

    def load_state_dict(self, state: dict[str, str]) -> None:
        """Compare with the demonstrations of the training that is to go on.

        Raises:
            ValueError: these are others.
        """
        if state["windows"] != self._digest:
            raise ValueError(
                f"the training that is to go on was started with other demonstrations than those in {self._folder}: "
                "give collect.folder=DIR where they are, or start a training without checkpoint="
            )

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
def _shuffled(count: int, seed: Seed, number: int) -> Array:
    return np.random.default_rng([seed, number]).permutation(count)
