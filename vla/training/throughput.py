"""Throughput metrics and the progress bar of training."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from vla.io.progress import Bar

MAX_WAITING_SHARE = 0.05  # share of time spent waiting for data above which the bar shows it


class Throughput(Callback):
    """Logs throughput between two log steps, excluding validation.

    - `pace/samples_per_s`: samples per second of all processes.
    - `pace/waiting`: share of the time in which this process waited for data, from `waited` [s] of the data loader.
    - `pace/memory_gb`: peak memory, on GPUs.

    Lightning's `ThroughputMonitor` synchronises the GPU in every step and does not measure data loading.
    """

    def __init__(self) -> None:
        self._batches, self._start, self._pause_start, self._initial_waiting = 0, 0.0, 0.0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the measurement."""
        self._batches, self._start, self._initial_waiting = 0, time.perf_counter(), _waiting_seconds(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Pause the measurement."""
        self._pause_start = time.perf_counter()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Resume the measurement."""
        self._start += time.perf_counter() - self._pause_start

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log every `log_every_n_steps` batches."""
        self._batches += 1
        interval = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not interval or (batch_idx + 1) % interval:
            return
        seconds = time.perf_counter() - self._start
        pace = {
            "pace/samples_per_s": self._batches * trainer.world_size * len(batch["action"]) / seconds,
            "pace/waiting": (_waiting_seconds(trainer) - self._initial_waiting) / seconds,
        }
        if pl_module.device.type == "cuda":
            pace["pace/memory_gb"] = torch.cuda.max_memory_allocated(pl_module.device) / 1e9
        pl_module.log_dict(pace)
        self.on_train_start(trainer, pl_module)


def _waiting_seconds(trainer: Trainer) -> float:
    """Return the time spent waiting for batches [s]; 0 for data loaders that do not measure it."""
    return float(getattr(trainer.train_dataloader, "waited", 0.0))


class TrainingProgressBar(Callback):
    """Progress bar over the batches of a training, with loss, throughput, success, and the share of waiting if it is
    much.

    Lightning's own bar labels training without epochs "Epoch 0/-2", and restarts at 0 after resuming.
    """

    READ_EVERY = 10  # batches; each read of a loss or a metric synchronises the GPU

    def __init__(self) -> None:
        self._bar: Bar | None = None  # of the first process, from the first batch on
        self._note = ""  # empty before the first step, also after resuming

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance the bar; read loss and metrics every `READ_EVERY` batches."""
        if not trainer.is_global_zero:
            return
        parts = trainer.accumulate_grad_batches
        if not self._note or batch_idx % self.READ_EVERY == 0:
            loss = outputs["loss"].item() * parts  # Lightning divides it by these
            self._note = _note(loss, trainer.callback_metrics)
        if self._bar is None:  # not before, because it is painted over what others say at the start
            total = trainer.max_steps * parts if trainer.max_steps > 0 else None
            self._bar = Bar("training", total, batch_idx)
            self._bar.start()
        self._bar.show(batch_idx + 1, self._note)

    def on_train_end(self, *_: Any) -> None:
        """End the bar, also after an error."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    on_exception = on_train_end


def _note(loss: float, metrics: Mapping[str, Any]) -> str:
    """Describe the state of a training."""
    notes = [f"loss {loss:.3f}"]
    if "pace/samples_per_s" in metrics:
        notes.append(f"{metrics['pace/samples_per_s']:.0f} samples/s")
    if "val/success" in metrics:
        notes.append(f"success {metrics['val/success']:.0%}")
    if metrics.get("pace/waiting", 0) > MAX_WAITING_SHARE:
        notes.append(f"waiting {metrics['pace/waiting']:.0%}")
    return ", ".join(notes)
