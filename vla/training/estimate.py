"""What a training needs of memory and time: said before it starts, and compared with what it took."""

from __future__ import annotations

import logging
import resource
import statistics
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities.seed import isolate_rng

from vla.config.differences import at
from vla.io.errors import UserError
from vla.models.fsdp import local_shard
from vla.models.layers import Batch
from vla.models.learner import Learner
from vla.parallel.limits import free_memory, memory
from vla.training.ema import EMA, EVERY

log = logging.getLogger(__name__)

SIZE_KEYS = ("data.batch_size", "model.context.history", "model.image_size", "model.chunk", "model.width")
TRIALS_S = 1.0  # trial steps of a larger batch end after this time [s]
REPEATED = 3  # steps of the largest trial
TOLERANCE = 1.15  # a training is refused if it needs that much more than there is
OPTIMIZED = 20_000_000  # numbers that one optimiser step is timed with
GB = 1e9


class Trial(NamedTuple):
    """Steps with a batch of some windows."""

    windows: int
    peak: float  # memory of the process, or allocated on the GPU [bytes]
    seconds: float  # of one step


def what_to_lower(config: Mapping[str, Any]) -> str:
    """Return which options to change for a training of less memory."""
    keys = [f"{key} (now {size})" for key in SIZE_KEYS if (size := at(config, key, None))]
    return (
        f"lower {', '.join(keys)}; trainer.precision=bf16 and learner.checkpointing=true need less, and "
        "trainer.accumulate_grad_batches=2 makes one step of two batches of half the size"
    )


class Estimate(Callback):
    """Estimates memory and time of a training from a few steps with small batches, without changing it.

    Trials with 1, 4, 16, … windows end at the size of the training's batches, or once they take long; then lines
    through the last two tell the rest. What trials lack is counted: optimiser state, EMA weights and waiting batches.

    Args:
        config: of the training, to name what can be lowered.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        self._memory, self._seconds = 0.0, 0.0  # estimated, of the process and of a step
        self._took: deque[float] = deque(maxlen=1000)  # [s] of the last steps
        self._began: float | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Estimate.

        Raises:
            UserError: the memory does not suffice.
        """
        assert isinstance(pl_module, Learner)
        device, weights = pl_module.device, [local_shard(w) for w in pl_module.parameters() if w.requires_grad]
        averaged = [*weights, *pl_module.buffers()] if any(isinstance(c, EMA) for c in trainer.callbacks) else []  # type: ignore[attr-defined]
        state = 2 * sum(weight.nbytes for weight in weights) + sum(each.nbytes for each in averaged)
        held = _held(device)
        available = (held + _free(device)) / (trainer.world_size // trainer.num_nodes if device.type == "cpu" else 1)
        self._require(held + state + sum(weight.nbytes for weight in weights), available)
        with _unchanged(pl_module):
            trials, batch_bytes = self._trials(trainer, pl_module, available)
            optimizer = _optimizer_seconds(weights, bool(averaged))
        size, ahead = trainer.datamodule.batch_size, trainer.datamodule.ahead  # type: ignore[attr-defined]
        waiting = (ahead + 1) * size * batch_bytes if device.type == "cpu" else 0
        self._memory = _extrapolated([(each.windows, each.peak) for each in trials], size) + state + waiting
        step = _extrapolated([(each.windows, each.seconds) for each in trials], size)
        self._seconds = step + optimizer / trainer.accumulate_grad_batches
        self._require(self._memory, available)
        self._available = available

    def _require(self, needed: float, available: float) -> None:
        if needed > TOLERANCE * available:
            raise UserError(
                f"training needs about {needed / GB:.1f} GB of memory, and {available / GB:.1f} GB are there: "
                f"{what_to_lower(self._config)}"
            )

    def _trials(self, trainer: Trainer, learner: Learner, available: float) -> tuple[list[Trial], float]:
        """Return the trials, and the memory of a window in a batch [bytes]."""
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        windows, trials, began = 1, list[Trial](), time.perf_counter()
        order = data.order(0)
        while True:
            batch = data.make_batch(order[:windows])
            per_window = _bytes(batch) / windows
            batch = learner.transfer_batch_to_device(batch, learner.device, 0)
            batch = learner.on_after_batch_transfer(batch, 0)
            _reset_peak(learner.device)
            last = windows == data.batch_size
            seconds = [_step(trainer, learner, batch) for _ in range(2)]
            while last and len(seconds) < REPEATED and self._all(trainer, time.perf_counter() - began < TRIALS_S):
                seconds.append(_step(trainer, learner, batch))
            trials.append(Trial(windows, _peak(learner.device), statistics.median(seconds[1:])))
            if last:
                return trials, per_window
            following = min(4 * windows, data.batch_size)
            peak = _extrapolated([(each.windows, each.peak) for each in trials], following)
            spent = time.perf_counter() - began + 2 * seconds[-1] * following / windows
            if not self._all(trainer, spent < TRIALS_S and peak < available):
                if len(trials) > 1:
                    return trials, per_window
                following = windows + 1
            windows = following

    @staticmethod
    def _all(trainer: Trainer, decision: bool) -> bool:
        """Return whether all processes decide so: their steps wait for each other."""
        return bool(trainer.strategy.reduce_boolean_decision(decision, all=True))

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what was estimated, of the steps that are left."""
        batches = (trainer.max_steps - trainer.global_step) * trainer.accumulate_grad_batches
        whole = (
            f"{_duration(batches * self._seconds)} for {batches} batches" if trainer.max_steps > 0 else "without end"
        )
        log.info(
            "needs about %.2f of %.1f GB of memory, and %s of %.0f ms, without validation; if that is too much, %s",
            *(self._memory / GB, self._available / GB, whole, 1000 * self._seconds, what_to_lower(self._config)),
        )
        _reset_peak(pl_module.device)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Time the batch before, unless a validation came between."""
        now = time.perf_counter()
        if self._began is not None:
            self._took.append(now - self._began)
        self._began = now

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave a validation out."""
        self._began = None

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what the training took."""
        if self._took:
            log.info(
                "took %.2f GB of memory and %.0f ms for a batch, after an estimate of %.2f GB and %.0f ms",
                *(_peak(pl_module.device) / GB, 1000 * statistics.median(self._took)),
                *(self._memory / GB, 1000 * self._seconds),
            )


@contextmanager
def _unchanged(learner: Learner) -> Iterator[None]:
    """Leave random numbers, buffers and gradients as they are, and compute as in training, but not compiled."""
    before = [buffer.clone() for buffer in learner.buffers()]
    with isolate_rng(), torch.compiler.set_stance("force_eager"):
        learner.on_fit_start()
        try:
            yield
        finally:
            learner.teardown("fit")
            learner.zero_grad()
            with torch.no_grad():
                for buffer, value in zip(learner.buffers(), before, strict=True):
                    buffer.copy_(value)


def _step(trainer: Trainer, learner: Learner, batch: Batch) -> float:
    """Return the time of a step but for the optimiser [s]; gradients of the last one are there, as in training."""
    _synchronize(learner.device)
    began = time.perf_counter()
    with trainer.precision_plugin.train_step_context():
        loss = learner.model.loss(learner.model.augment(batch))["loss"]
    learner.zero_grad()
    loss.backward()
    _synchronize(learner.device)
    return time.perf_counter() - began


def _optimizer_seconds(weights: list[torch.Tensor], averages: bool) -> float:
    """Return the time of clipping, AdamW and EMA [s], from copies of some of the weights."""
    some, numbers = list[torch.Tensor](), 0
    for weight in weights:
        if numbers < OPTIMIZED:
            some.append(torch.zeros_like(weight, requires_grad=True))
            some[-1].grad = torch.zeros_like(weight)
            numbers += weight.numel()
    optimizer, seconds = torch.optim.AdamW(some, fused=True), list[float]()
    for _ in range(REPEATED):
        _synchronize(weights[0].device)
        began = time.perf_counter()
        torch.nn.utils.clip_grad_norm_(some, 1.0)
        optimizer.step()
        _synchronize(weights[0].device)
        seconds.append((1 + averages / (3 * EVERY)) * (time.perf_counter() - began))  # EMA reads and writes a third
    return min(seconds) * sum(weight.numel() for weight in weights) / max(numbers, 1)


def _extrapolated(points: list[tuple[int, float]], size: int) -> float:
    """Return the value at a size, from the last point if it has that size, or else the line through the last two."""
    (x, y), (x_before, y_before) = points[-1], points[-2] if len(points) > 1 else (0, 0.0)
    return y + (y - y_before) / (x - x_before) * (size - x) if size != x else y


def _bytes(batch: Any) -> int:
    return sum(map(_bytes, batch.values())) if isinstance(batch, dict) else getattr(batch, "nbytes", 0)


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _reset_peak(device: torch.device) -> None:
    """Forget the largest memory so far."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with suppress(OSError):  # elsewhere, or where it is not allowed, that of the whole process counts
        Path("/proc/self/clear_refs").write_text("5")


def _peak(device: torch.device) -> float:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _held(device: torch.device) -> float:
    return torch.cuda.memory_allocated(device) if device.type == "cuda" else psutil.Process().memory_info().rss


def _free(device: torch.device) -> float:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else free_memory() * memory()


def _duration(seconds: float) -> str:
    return (
        f"{seconds / 3600:.1f} h"
        if seconds > 5400
        else f"{seconds / 60:.1f} min"
        if seconds > 90
        else f"{seconds:.0f} s"
    )
