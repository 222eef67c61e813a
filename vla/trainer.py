"""Lightning's trainer as a configuration describes it, made to stop cleanly and to write atomically."""

from __future__ import annotations

import csv
import ctypes
import logging
import os
import platform
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import CSVLogger, Logger
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.strategies import ParallelStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from vla.averaging import Averaging
from vla.check import build
from vla.files import atomic_path
from vla.progress import Pace, Progress
from vla.resume import LAST
from vla.workers import cores

log = logging.getLogger(__name__)

SAVE_EVERY = 500  # steps
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
LARGEST = 2**25  # that MMAP_THRESHOLD may be [B]
SIZES = ("history", "image_size", "chunk", "width")  # of a model, as far as it has them, that memory grows with


class Interruption(Checkpoint):
    """At the first SIGINT or SIGTERM training saves and stops after the current step, at the second one at once.

    Processes that train together stop together, whichever of them was asked to. As one of Lightning's checkpoints it
    comes after all other callbacks. Every checkpoint says whether training was `finished`, and how many `seconds` it
    took.
    """

    def __init__(self, checkpoints: Path) -> None:
        self._path, self._before, self._began = checkpoints / LAST, 0.0, time.monotonic()
        self.asked = self.stopped = self._heard = self._whole = False

    @property
    def seconds(self) -> float:
        """How long the training has taken by now, what it went on from included [s]."""
        return self._before + time.monotonic() - self._began

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Within, the signals are heard, and the time counts; only the main thread can hear them."""
        self._began = time.monotonic()
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
        if self._heard:  # another process may have asked before
            self.stopped = True  # in the middle of something: the checkpoint before is the last whole one
            raise KeyboardInterrupt
        self._heard = self.asked = True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save while everything that goes on from here is still at hand, and no gradient half gathered."""
        self._whole = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        if not _validates(trainer, batch_idx):
            self._stop(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Where a step is validated, save after that: who went on from before it would leave it out."""
        self._stop(trainer)

    def _stop(self, trainer: Trainer) -> None:
        if not self._whole:
            return
        # A signal that comes after this, and so to one process only, is heard of in the next step.
        if trainer.strategy.reduce_boolean_decision(self.asked, all=False) and not trainer.should_stop:
            self.asked = self.stopped = True
            trainer.save_checkpoint(self._path, weights_only=False)
            trainer.should_stop = True
            trainer.limit_val_batches = 0  # else Lightning validates once more before it stops
            log.info("interrupted after %d steps, see %s; checkpoint=last goes on", trainer.global_step, self._path)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """A checkpoint of a training that is over is not to be gone on from."""
        checkpoint["finished"], checkpoint["seconds"] = trainer.state.finished, self.seconds

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Count from what the training had taken."""
        self._before = checkpoint.get("seconds", 0.0)


class Saving(Checkpoint):
    """Keeps `last.ckpt` of every so many steps, of one that is validated after its validation."""

    def __init__(self, checkpoints: Path) -> None:
        self._path, self._due, self._step = checkpoints / LAST, False, -1

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save, or leave it to the validation that follows."""
        step = trainer.global_step
        self._due, self._step = step != self._step and step % SAVE_EVERY == 0, step
        if not _validates(trainer, batch_idx):
            self._save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save what was left over."""
        self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        if self._due:
            self._due = False
            trainer.save_checkpoint(self._path, weights_only=False)


def _validates(trainer: Trainer, batch_idx: int) -> bool:
    every = trainer.val_check_batch
    return bool(trainer.enable_validation and every and (batch_idx + 1) % every == 0)


class AtomicFiles(TorchCheckpointIO):
    """Checkpoints take the place of the one before only when they are complete."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write beside `path`, then rename.

        Raises:
            OSError: it cannot be written; what was at `path` still is.
        """
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as draft, draft.open("wb") as file:
            try:
                torch.save(checkpoint, file)
            except RuntimeError as error:
                if isinstance(error.__context__, OSError):  # what the disk said
                    raise error.__context__ from None
                raise
            os.fsync(file.fileno())


class Draws(Callback):
    """What a step of training draws follows from the seed, the number of the step and the process alone.

    So nothing that happened before it, such as a validation or an interruption, changes it.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Seed everything that torch draws, on all devices."""
        parts = trainer.accumulate_grad_batches
        step = trainer.global_step * parts + batch_idx % parts
        numbers = np.random.SeedSequence([self._seed, step, trainer.global_rank]).generate_state(1, np.uint64)
        torch.manual_seed(int(numbers[0]))


def make_trainer(config: DictConfig, checkpoints: Path | None, *watching: Callback) -> Trainer:
    """The trainer of a configuration, which averages the weights, and logs and keeps its last checkpoint if there is a
    place; in validation those who watch see the averaged weights.

    Raises:
        ValueError: the machine has not what it asks for, or a logger's package is missing.
    """
    _hold_memory()
    callbacks: list[Callback] = [Progress(), *watching]
    options: dict[str, Any] = {"logger": False, "enable_checkpointing": False}
    if config.learner.ema:
        callbacks.append(Averaging(config.learner.ema))
    if checkpoints is not None:
        callbacks += [Pace(), Saving(checkpoints)]
        options = {"logger": _loggers(config, checkpoints.parent)}
    callbacks.append(Draws(config.seed))  # after all that might draw something itself
    try:
        trainer: Trainer = build(config.trainer, "trainer", callbacks=callbacks, **options)
        if isinstance(trainer.strategy, ParallelStrategy) and trainer.strategy.cluster_environment:
            # As many processes as a cluster started, of which Lightning would not speak before the training.
            trainer.strategy.cluster_environment.validate_settings(trainer.num_devices, trainer.num_nodes)
    except RuntimeError as error:  # of a cluster that was asked for its processes in another way
        raise ValueError(f"training cannot start in this environment: {error}") from error
    except (MisconfigurationException, ValueError) as error:
        names = ("accelerator", "devices", "num_nodes", "strategy", "precision")
        said = {name: config.trainer[name] for name in names if name in config.trainer}
        asked = [f"trainer.{name}={value}" for name, value in said.items() if not isinstance(value, DictConfig)]
        raise ValueError(f"{' '.join(asked)} cannot be had here ({error}): try trainer=cpu or trainer=auto") from error
    _require_cores(trainer)
    trainer.strategy.checkpoint_io = AtomicFiles()
    return trainer


def _require_cores(trainer: Trainer) -> None:
    """Refuse more processes on this CPU than it has cores; processes of a cluster have each their own."""
    environment = getattr(trainer.strategy, "cluster_environment", None)
    elsewhere = environment is not None and environment.creates_processes_externally
    if isinstance(trainer.accelerator, CPUAccelerator) and not elsewhere and trainer.num_devices > cores():
        raise ValueError(
            f"trainer.devices={trainer.num_devices} asks for more processes than this machine has cores: set "
            f"trainer.devices={cores()} or fewer"
        )


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


def keep_metrics(trainer: Trainer, checkpoint: Path) -> None:
    """Let the metrics of a training that goes on begin with those that led to its checkpoint."""
    source = checkpoint.parent.parent / "metrics.csv"
    writers = [logger for logger in trainer.loggers if isinstance(logger, CSVLogger)]
    if not writers or not source.exists() or not trainer.is_global_zero:
        return
    steps = torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)["global_step"]
    with source.open(newline="", encoding="utf-8") as file:
        rows = [{name: value for name, value in row.items() if value} for row in csv.DictReader(file)]
    # Lightning begins with an empty file.
    writers[0].experiment.metrics = [row for row in rows if int(row["step"]) < steps]
    writers[0].save()


def _hold_memory() -> None:
    """Keep what a step frees for the next one: given back to the system it comes again page by page, which took 7 % of
    a step of `bc` on a CPU and 12 % of `rt1_tiny`."""
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(MMAP_THRESHOLD, LARGEST)
        library.mallopt(TRIM_THRESHOLD, -1)  # never


def _loggers(config: DictConfig, folder: Path) -> list[Logger]:
    loggers = []
    for name, node in (config.logger or {}).items():
        try:
            loggers.append(build(node, "logger", save_dir=str(folder)))
        except ModuleNotFoundError as error:
            raise ValueError(
                f"logger.{name} needs a package that is not installed: pip install 'vla[{name}]'"
            ) from error
    return loggers


def quiet_lightning() -> None:
    """Lightning prints advertisements and, through handlers of its own, every line twice under Hydra."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).handlers.clear()
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    # What its own callbacks do with its own hooks is nothing that a user could change.
    warnings.filterwarnings("ignore", module=r"lightning\.")
    warnings.filterwarnings("ignore", "FSDP2-wrapped module .* returned a view")  # which nobody here writes into
