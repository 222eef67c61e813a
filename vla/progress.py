"""What a training says of itself while it runs: how fast it is, what it waits for, when it will end."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar

from vla.models.flops import matmul_flops, peak_flops, training_flops
from vla.models.learner import Learner

PEAK_SECONDS = 0.1  # for which a device of unknown peak is measured


class Pace(Callback):
    """Logs, since the last time, `pace/samples_per_s` of all processes, `pace/waiting`, the share of the time in which
    this process waited for its batch, `pace/mfu`, the share of the device's peak that the model's own arithmetic
    takes (model FLOPs utilisation, arXiv 2204.02311), and on GPUs `pace/memory_gb`, the most that was in use.
    Without a data sheet the peak is the best rate measured so far, of matrix products or of the training itself.

    Validation does not count. The stream of batches counts the seconds that it was waited for as `waited`.
    """

    def __init__(self) -> None:
        self._flops = self._peak = 0.0  # of a step of this process, and of its device in a second
        self._batches, self._began, self._paused, self._waited = 0, 0.0, 0.0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to count."""
        self._restart(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop the clock."""
        self._paused = time.perf_counter()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Go on."""
        self._began += time.perf_counter() - self._paused

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Count once what a batch takes, all of which are of one size."""
        assert isinstance(pl_module, Learner)
        if not self._flops and pl_module.device_mesh is None:
            device = pl_module.device
            self._flops = training_flops(pl_module.model, batch)
            self._peak = peak_flops(device, trainer.precision) or matmul_flops(device, trainer.precision, PEAK_SECONDS)
            self._restart(trainer)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log as often as the trainer logs."""
        self._batches += 1
        every = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not every or (batch_idx + 1) % every:
            return
        seconds = time.perf_counter() - self._began
        samples = self._batches * trainer.world_size * len(batch["action"])
        pace = {
            "pace/samples_per_s": samples / seconds,
            "pace/waiting": (_waited(trainer) - self._waited) / seconds,
        }
        if self._flops:  # not where weights are shared out, of which no copy can be made to count on
            rate = self._flops * self._batches / seconds
            self._peak = max(self._peak, rate)
            pace["pace/mfu"] = rate / self._peak
        if pl_module.device.type == "cuda":
            pace["pace/memory_gb"] = torch.cuda.max_memory_allocated(pl_module.device) / 1e9
        pl_module.log_dict(pace)
        self._restart(trainer)

    def _restart(self, trainer: Trainer) -> None:
        self._batches, self._began, self._waited = 0, time.perf_counter(), _waited(trainer)


def _waited(trainer: Trainer) -> float:
    """How long the batches of a training were waited for [s]; unknown, as 0, of others than the project's own."""
    return float(getattr(trainer.train_dataloader, "waited", 0.0))


class Progress(RichProgressBar):
    """The progress of a training that counts steps: Lightning's own bar calls an endless one "Epoch 0/-2", and begins
    to count anew when one goes on."""

    READ_EVERY = 10  # steps; each time a GPU is waited for

    def __init__(self) -> None:
        super().__init__(refresh_rate=4)  # a second: painting takes milliseconds, in a thread that the model waits for
        self._loss = float("nan")

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move on; now and then read the loss off the device."""
        if batch_idx % self.READ_EVERY == 0:
            self._loss = outputs["loss"].item()
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    @property
    def total_train_batches(self) -> int | float:
        """Of the whole training, or infinity where only time bounds it."""
        trainer = self.trainer
        return trainer.max_steps * trainer.accumulate_grad_batches if trainer.max_steps > 0 else float("inf")

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """What stands beside the bar: the loss, samples per second, the share of waiting for data, success."""
        logged = trainer.callback_metrics
        shown: dict[str, int | str | float | dict[str, float]] = {"loss": f"{self._loss:.3f}"}
        if "pace/samples_per_s" in logged:
            shown["samples/s"] = f"{logged['pace/samples_per_s']:.0f}"
            shown["waiting"] = f"{logged['pace/waiting']:.0%}"
        if "val/success" in logged:
            shown["success"] = f"{logged['val/success']:.0%}"
        return shown

    def _get_train_description(self, current_epoch: int) -> str:
        return "training".ljust(len(self.validation_description))  # bars of one length do not flicker
