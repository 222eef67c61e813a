"""Estimates of the memory and time of a training, logged before it starts and compared with the actual values."""

from __future__ import annotations

import logging
import statistics
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from vla.io.errors import UserError, counted
from vla.models.fsdp import local_shard
from vla.models.learner import Learner
from vla.training.device import memory_of, peak, reset_peak, synchronized_time
from vla.training.ema import EMA, UPDATE_INTERVAL
from vla.training.trainer import what_to_lower

log = logging.getLogger(__name__)

TRIALS_S = 2.0  # after which no larger batch is tried [s], unless the training is long
LONG_TRAINING = 500  # smallest number of batches of a long training, whose trials go on up to its batch size
TOLERANCE = 1.15  # a training is refused if it needs more than this multiple of the available memory
SCARCE = 0.5  # share of the memory above which a training says what to lower
OPTIMIZER_SAMPLE = 20_000_000  # number of parameters with which a step of the optimiser is timed
FIRST_STEP = 40e6  # memory that libraries allocate in the first step, measured for four models [bytes]
GB = 1e9


class Estimate(Callback):
    """Estimates memory and time of a training from a few steps with small batches, without changing it.

    Trials of 2, 8, 32, … windows end at the batch size, before they exceed the memory or, in short trainings, once they
    take long; a line through the last two then gives the rest. Optimiser state, EMA and waiting batches are added.

    Args:
        config: of the training, to name what can be lowered.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config, self._usage, self._capacity = config, 0.0, 0.0  # [bytes]
        self._peaks, self._seconds = dict[int, float](), dict[int, float]()  # windows of a trial → [bytes], [s]
        self.memory, self.seconds = 0.0, 0.0  # estimated, of the process [bytes] and of a batch [s]
        self._batch_seconds: deque[float] = deque(maxlen=1000)  # times of the last batches [s]
        self._batch_start: float | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Compute the estimate; the model is on its device by now.

        Raises:
            UserError: the memory does not suffice.
        """
        assert isinstance(pl_module, Learner)
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        device, on_cpu = pl_module.device, pl_module.device.type == "cpu"
        weights = [local_shard(weight) for weight in pl_module.parameters() if weight.requires_grad]
        averages = [*weights, *pl_module.buffers()] if any(isinstance(callback, EMA) for callback in callbacks) else []
        self._usage, free = memory_of(device)
        self._capacity = self._usage + free / (trainer.world_size // trainer.num_nodes if on_cpu else 1)
        state = 2 * sum(tensor.nbytes for tensor in weights) + sum(tensor.nbytes for tensor in averages)
        self._peaks, self._seconds = {0: self._usage + sum(item.nbytes for item in weights)}, {0: 0.0}  # with gradients
        self._require(self._peaks[0] + state)
        with _preserved_state(pl_module):
            window = self._run_trials(trainer, pl_module, data)
            optimizer = _optimizer_seconds(weights, device, bool(averages))
        waiting = (data.ahead + 2) * data.batch_size * window + FIRST_STEP if on_cpu else 0  # Lightning takes one ahead
        self.memory = extrapolate(self._peaks, data.batch_size) + state + waiting
        self.seconds = extrapolate(self._seconds, data.batch_size) + optimizer / trainer.accumulate_grad_batches
        self._require(self.memory)

    def _require(self, needed: float) -> None:
        if needed > TOLERANCE * self._capacity:
            raise UserError(
                f"training needs about {needed / GB:.1f} GB of memory, and {self._capacity / GB:.1f} GB are there: "
                f"{what_to_lower(self._config)}"
            )

    def _run_trials(self, trainer: Trainer, learner: Learner, data: Any) -> float:
        """Run the trials, the same in all processes, and return the size of a window in a batch [bytes]."""
        windows, start = min(2, data.batch_size), time.perf_counter()  # batch normalisation needs two
        while True:
            batch = data.make_batch(data.order(0)[:windows])
            window = sum(value.nbytes for value in _tensors(batch)) / windows
            batch = learner.on_after_batch_transfer(learner.transfer_batch_to_device(batch, learner.device, 0), 0)
            reset_peak(learner.device)
            seconds = [_step(trainer, learner, batch) for _ in range(4 if windows == data.batch_size else 2)]
            self._peaks[windows], self._seconds[windows] = peak(learner.device), statistics.median(seconds[1:])
            if windows == data.batch_size:
                return window
            next_size = min(4 * windows, data.batch_size)
            duration = time.perf_counter() - start + 2 * self._seconds[windows] * next_size / windows  # after two steps
            long = not 0 <= batches_left(trainer) < LONG_TRAINING
            affordable = long or duration < (TRIALS_S if windows > 2 else 5 * TRIALS_S)  # a line needs a second trial
            fits = extrapolate(self._peaks, next_size) < self._capacity
            if not trainer.strategy.reduce_boolean_decision(affordable and fits, all=True):
                return window
            windows = next_size

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the estimate for the remaining steps."""
        batches = batches_left(trainer)
        scarce = self.memory > SCARCE * self._capacity
        advice = f"; if that is too much, {what_to_lower(self._config)}" if scarce else ""
        length = f"{batches * self.seconds / 60:.1f} min for {counted(batches, 'batch')}" if batches >= 0 else "batches"
        log.info(
            "training needs about %.2f of %.1f GB of memory (it holds %.2f) and %s of %.0f ms, without validation%s",
            *(self.memory / GB, self._capacity / GB, self._usage / GB, length, 1000 * self.seconds, advice),
        )
        reset_peak(pl_module.device)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Record the time of the previous batch, unless a validation came between."""
        timestamp = time.perf_counter()
        if self._batch_start is not None:
            self._batch_seconds.append(timestamp - self._batch_start)
        self._batch_start = timestamp

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Exclude the validation from the times."""
        self._batch_start = None

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the actual memory and time."""
        if self._batch_seconds:
            log.info(
                "training took %.2f GB of memory and %.0f ms for a batch, after an estimate of %.2f GB and %.0f ms",
                *(peak(pl_module.device) / GB, 1000 * statistics.median(self._batch_seconds)),
                *(self.memory / GB, 1000 * self.seconds),
            )


@contextmanager
def _preserved_state(learner: Learner) -> Iterator[None]:
    """Compute as in training but uncompiled; restore random states and buffers afterwards, and clear gradients."""
    saved_buffers = [buffer.clone() for buffer in learner.buffers()]
    with isolate_rng(), torch.compiler.set_stance("force_eager"):
        learner.on_fit_start()
        try:
            yield
        finally:
            learner.teardown("fit")
    learner.zero_grad()
    with torch.no_grad():
        for buffer, value in zip(learner.buffers(), saved_buffers, strict=True):
            buffer.copy_(value)


def _step(trainer: Trainer, learner: Learner, batch: Any) -> float:
    """Return the time of a step without the optimiser [s]; as in training, previous gradients are still allocated."""
    start = synchronized_time(learner.device)
    with trainer.precision_plugin.train_step_context():
        loss = learner.model.loss(learner.model.augment(batch))["loss"]
    learner.zero_grad()
    loss.backward()
    return synchronized_time(learner.device) - start


def _optimizer_seconds(weights: list[Tensor], device: torch.device, averages: bool) -> float:
    """Return the time of clipping, AdamW and EMA [s], extrapolated from zeros in the shape of some of the weights."""
    sample = list[Tensor]()
    for weight in weights:
        if sum(tensor.numel() for tensor in sample) < OPTIMIZER_SAMPLE:
            sample.append(torch.zeros_like(weight, requires_grad=True))
            sample[-1].grad = torch.zeros_like(weight)
    optimizer, seconds = torch.optim.AdamW(sample, fused=True), list[float]()
    for _ in range(3):
        start = synchronized_time(device)
        torch.nn.utils.clip_grad_norm_(sample, 1.0)
        optimizer.step()
        seconds.append(synchronized_time(device) - start)
    share = sum(tensor.numel() for tensor in sample) / sum(tensor.numel() for tensor in weights)
    # EMA reads and writes a third of what AdamW does.
    return min(seconds) / share * (1 + averages / (3 * UPDATE_INTERVAL))


def batches_left(trainer: Trainer) -> int:
    """Return how many batches are left; below 0 without an end."""
    return (trainer.max_steps - trainer.global_step) * trainer.accumulate_grad_batches


def extrapolate(points: Mapping[int, float], size: int) -> float:
    """Return the value at a size: that of its point, or else that of the line through the last two points."""
    (first_size, low), (last_size, high) = list(points.items())[-2:]
    return points[size] if size in points else high + max(high - low, 0) / (last_size - first_size) * (size - last_size)


def _tensors(batch: Any) -> list[Tensor]:
    parts = batch.values() if isinstance(batch, dict) else ()
    return [batch] if isinstance(batch, Tensor) else [tensor for part in parts for tensor in _tensors(part)]
