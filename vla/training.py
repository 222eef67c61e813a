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
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.strategies import ParallelStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from vla.averaging import Averaging
from vla.check import build

log = logging.getLogger(__name__)

LAST = "last.ckpt"
SAVE_EVERY = 500  # steps


class Interruption(Callback):
    """At the first SIGINT or SIGTERM training saves and stops after the current step, at the second one at once.

    Processes that train together stop together, whichever of them was asked to.
    """

    def __init__(self, checkpoints: Path) -> None:
        self._path = checkpoints / LAST
        self.asked = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Within, the signals are heard; only the main thread can hear them."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = self._listen()
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _listen(self) -> dict[signal.Signals, Any]:
        return {number: signal.signal(number, self._hear) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Lightning's own handler waits for the other processes wherever it is called, and they for it."""
        if signal.getsignal(signal.SIGINT) == self._hear:
            self._listen()

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Save while everything that goes on from here is still at hand."""
        if trainer.strategy.reduce_boolean_decision(self.asked, all=False):
            self.asked = True  # and never False: a signal may have come meanwhile, which the next step hears of
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


class Progress(RichProgressBar):
    """The progress of a training that counts steps: Lightning's own bar calls an endless one "Epoch 0/-2"."""

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
        if isinstance(trainer.strategy, ParallelStrategy) and trainer.strategy.cluster_environment:
            # As many processes as a cluster started, of which Lightning would not speak before the training.
            trainer.strategy.cluster_environment.validate_settings(trainer.num_devices, trainer.num_nodes)
    except (MisconfigurationException, ValueError) as error:
        names = ("accelerator", "devices", "num_nodes", "strategy", "precision")
        said = {name: config.trainer[name] for name in names if name in config.trainer}
        asked = [f"trainer.{name}={value}" for name, value in said.items() if not isinstance(value, DictConfig)]
        raise ValueError(f"{' '.join(asked)} cannot be had here ({error}): try trainer=cpu or trainer=auto") from error
    trainer.strategy.checkpoint_io = AtomicFiles()
    return trainer


def quiet_lightning() -> None:
    """Lightning prints advertisements and, through handlers of its own, every line twice under Hydra."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).handlers.clear()
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    # What its own callbacks do with its own hooks is nothing that a user could change.
    warnings.filterwarnings("ignore", module=r"lightning\.")
    warnings.filterwarnings("ignore", "FSDP2-wrapped module .* returned a view")  # which nobody here writes into
