"""Throughput metrics and the progress bar of training."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from rich.progress import TimeRemainingColumn
from rich.table import Column

from vla.io.progress import Lines

MUCH = 0.05  # share of the time that waits for data, above which the bar shows it


class Throughput(Callback):
    """Logs throughput between two log steps, without validation.

    - `pace/samples_per_s`: samples per second of all processes.
    - `pace/waiting`: share of the time in which this process waited for data, from `waited` [s] of the data loader.
    - `pace/memory_gb`: peak memory, on GPUs.

    Lightning's `ThroughputMonitor` synchronises the GPU in every step and does not measure data loading.
    """

    def __init__(self) -> None:
        self._batches, self._began, self._paused, self._waited = 0, 0.0, 0.0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the measurement."""
        self._batches, self._began, self._waited = 0, time.perf_counter(), _waited(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Pause the measurement."""
        self._paused = time.perf_counter()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Resume the measurement."""
        self._began += time.perf_counter() - self._paused

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log every `log_every_n_steps` batches."""
        self._batches += 1
        every = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not every or (batch_idx + 1) % every:
            return
        seconds = time.perf_counter() - self._began
        pace = {
            "pace/samples_per_s": self._batches * trainer.world_size * len(batch["action"]) / seconds,
            "pace/waiting": (_waited(trainer) - self._waited) / seconds,
        }
        if pl_module.device.type == "cuda":
            pace["pace/memory_gb"] = torch.cuda.max_memory_allocated(pl_module.device) / 1e9
        pl_module.log_dict(pace)
        self.on_train_start(trainer, pl_module)


def _waited(trainer: Trainer) -> float:
    """Return the time spent waiting for batches [s]; 0 for data loaders that do not measure it."""
    return float(getattr(trainer.train_dataloader, "waited", 0.0))


class TrainingProgressBar(RichProgressBar):
    """Progress bar over training steps.

    Lightning's own bar labels training without epochs "Epoch 0/-2", and restarts at 0 after resuming.
    """

    READ_EVERY = 10  # steps; each read synchronises the GPU

    def __init__(self) -> None:
        super().__init__(refresh_rate=4)  # a second: painting takes milliseconds, in a thread that the model waits for
        self._loss: float | None = None  # unknown before the first step, also after resuming
        self._lines = Lines()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance the bar; read the loss every `READ_EVERY` batches."""
        if self._loss is None or batch_idx % self.READ_EVERY == 0:
            self._loss = outputs["loss"].item() * trainer.accumulate_grad_batches  # Lightning divides it by these
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        if self.is_enabled and self._lines.are_due():
            note = ", ".join(f"{name} {value}" for name, value in self.get_metrics(trainer, pl_module).items())
            self._lines.say("training", batch_idx + 1, self.total_train_batches, note, self._time_left())

    def _time_left(self) -> float | None:
        tasks = {task.id: task for task in self.progress.tasks} if self.progress else {}
        return tasks[self.train_progress_bar_id].time_remaining if self.train_progress_bar_id in tasks else None

    def configure_columns(self, trainer: Trainer) -> list[Any]:
        """Return what fits in a line of 80 columns beside the metrics, which would else take several lines."""
        description, bar, batches, _, speed = super().configure_columns(trainer)
        self._metric_component._table_column = Column(no_wrap=True)  # type: ignore[union-attr]
        return [description, bar, batches, TimeRemainingColumn(), speed]

    @property
    def total_train_batches(self) -> int | float:
        """Return the batches of the whole training; infinity if only its time is limited."""
        trainer = self.trainer
        return trainer.max_steps * trainer.accumulate_grad_batches if trainer.max_steps > 0 else float("inf")

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Return the columns beside the bar: loss, share of waiting for data if it is much, success."""
        logged = trainer.callback_metrics
        shown: dict[str, int | str | float | dict[str, float]] = {}
        if self._loss is not None:
            shown["loss"] = f"{self._loss:.3f}"
        if logged.get("pace/waiting", 0) > MUCH:
            shown["waiting"] = f"{logged['pace/waiting']:.0%}"
        if "val/success" in logged:
            shown["success"] = f"{logged['val/success']:.0%}"
        return shown

    def _get_train_description(self, current_epoch: int) -> str:
        return "training".ljust(len(self.validation_description))  # equal lengths avoid flicker
