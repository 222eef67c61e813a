"""Lightning's trainer as a configuration describes it, made to stop cleanly and to write atomically."""

from __future__ import annotations

import logging
import os
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar, WeightAveraging
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from vla.check import build

log = logging.getLogger(__name__)

LAST = "last.ckpt"
SAVE_EVERY = 500  # steps
SIZES = ("history", "image_size", "chunk", "width")  # of a model, as far as it has them, that memory grows with


class Interruption(Callback):
    """At the first SIGINT or SIGTERM training saves and stops after the current step, at the second one at once."""

    def __init__(self, checkpoints: Path) -> None:
        self._path = checkpoints / LAST
        self.asked = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Within, the signals are heard; only the main thread can hear them."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._hear) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Save while everything that goes on from here is still at hand."""
        if self.asked and not trainer.should_stop:
            trainer.save_checkpoint(self._path, weights_only=False)
            trainer.should_stop = True
            log.info("interrupted after %d steps; job=train checkpoint=%s goes on", trainer.global_step, self._path)


class AtomicFiles(TorchCheckpointIO):
    """Checkpoints take the place of the one before only when they are complete."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write beside `path`, then rename.

        Raises:
            OSError: it cannot be written; what was at `path` still is.
        """
        target = Path(path)
        draft = target.with_name(f"{target.name}.partial")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with draft.open("wb") as file:
                torch.save(checkpoint, file)
                os.fsync(file.fileno())
            os.replace(draft, target)
        except (OSError, RuntimeError) as error:  # torch wraps what the disk says
            raise OSError(
                f"{target} cannot be written, the one before is kept: {str(error).splitlines()[0]}"
            ) from error
        finally:
            draft.unlink(missing_ok=True)


class Averaging(WeightAveraging):
    """Keeps an exponential average of the weights beside them, updated in one operation after every step.

    Lightning's own would leave it in the memory of the CPU, where all weights would have to go after every step.

    Args:
        decay: per step.
    """

    def __init__(self, decay: float) -> None:
        super().__init__()
        self._decay = decay

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Follow the weights to their device, and note which average belongs to which."""
        assert self._average_model is not None
        average = self._average_model.to(pl_module.device).module
        both = ((*module.parameters(), *module.buffers()) for module in (average, pl_module))
        pairs = [(kept.detach(), current.detach()) for kept, current in zip(*both, strict=True)]
        floats = [pair for pair in pairs if pair[0].is_floating_point()]
        self._averages, self._weights = [kept for kept, _ in floats], [current for _, current in floats]
        self._counts = [pair for pair in pairs if not pair[0].is_floating_point()]

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """The first weights are their own average."""
        if trainer.global_step > self._latest_update_step:
            torch._foreach_lerp_(self._averages, self._weights, 1.0 if trainer.global_step == 1 else 1 - self._decay)
            for kept, current in self._counts:
                kept.copy_(current)
            self._latest_update_step = trainer.global_step


class Progress(RichProgressBar):
    """The progress of a training that counts steps: Lightning's own bar calls an endless one "Epoch 0/-2"."""

    READ_EVERY = 10  # steps; each time a GPU is waited for

    def __init__(self) -> None:
        super().__init__()
        self._shown: dict[str, Any] = {}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move on; now and then read the loss off the device."""
        if batch_idx % self.READ_EVERY == 0:
            self._shown = {"train/loss": outputs["loss"].item()}
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """What is shown beside the bar."""
        return self._shown

    def _get_train_description(self, current_epoch: int) -> str:
        return "training".ljust(len(self.validation_description))  # bars of one length do not flicker


def make_trainer(config: DictConfig, checkpoints: Path | None, *watching: Callback) -> Trainer:
    """The trainer of a configuration, which averages the weights and keeps its last checkpoint, if there is a place.

    Raises:
        ValueError: the machine has not what it asks for.
    """
    callbacks: list[Callback] = [Progress(), *watching]
    options: dict[str, Any] = {"logger": False, "enable_checkpointing": False}
    if config.learner.ema:
        callbacks.insert(1, Averaging(config.learner.ema))
    if checkpoints is not None:
        # After the averaging, whose weights it saves.
        callbacks.append(
            ModelCheckpoint(checkpoints, filename="last", every_n_train_steps=SAVE_EVERY, enable_version_counter=False)
        )
        options = {"logger": CSVLogger(checkpoints.parent, name="", version="")}
    try:
        trainer: Trainer = build(config.trainer, callbacks=callbacks, **options)
    except MisconfigurationException as error:
        asked = [f"trainer.{name}={config.trainer.get(name)}" for name in ("accelerator", "devices", "precision")]
        raise ValueError(f"{' '.join(asked)} cannot be had here ({error}): try trainer=cpu or trainer=auto") from error
    trainer.strategy.checkpoint_io = AtomicFiles()
    return trainer


@contextmanager
def enough_memory(config: DictConfig) -> Iterator[None]:
    """Within, whoever runs out of memory is told what to lower.

    Raises:
        ValueError: the memory, of the GPU or of the machine, is not enough.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, (MemoryError, torch.OutOfMemoryError)) and "can't allocate memory" not in str(error):
            raise
        keys = [f"data.batch_size (now {config.data.batch_size})"]
        keys += [f"model.{name} (now {config.model[name]})" for name in SIZES if config.model.get(name)]
        raise ValueError(
            f"training takes more memory than there is: lower {', '.join(keys)}; trainer.precision=bf16 takes less, "
            "and trainer.accumulate_grad_batches=2 makes one step of two batches of half the size"
        ) from error


def quiet_lightning() -> None:
    """Lightning prints advertisements and, through handlers of its own, every line twice under Hydra."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).handlers.clear()
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    # What its own callbacks do with its own hooks is nothing that a user could change.
    warnings.filterwarnings("ignore", module=r"lightning\.")
