"""Lightning's trainer from a config, with graceful stop, atomic checkpoints and exact resume."""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, cast

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import CSVLogger, Logger
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.strategies import ParallelStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from vla.config.build import build
from vla.io.documents import parse_plain
from vla.io.files import atomic_path
from vla.io.types import NonNegative
from vla.parallel.processes import cores
from vla.runs.folder import LAST, METRICS, metric_rows
from vla.training.ema import EMA
from vla.training.throughput import Throughput, TrainingProgressBar

log = logging.getLogger(__name__)

PRECISIONS = {"fp32": "32-true", "bf16": "bf16-mixed"}  # config → Lightning
SAVE_EVERY = 500  # steps
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
MAX_MMAP_THRESHOLD = 2**25  # [B]
SIZE_KEYS = ("history", "image_size", "chunk", "width")  # of a model; those that memory grows with


class GracefulStop(Checkpoint):
    """Saves and stops after the current step at the first SIGINT or SIGTERM, and stops at once at the second.

    All processes of a training stop together. As a Lightning `Checkpoint` it runs after all other callbacks. It adds
    `finished` and the training time `seconds` to every checkpoint.
    """

    def __init__(self, checkpoints: Path) -> None:
        self._path, self._previous_seconds, self._began = checkpoints / LAST, 0.0, time.monotonic()
        self.requested = self.stopped = self.started = self._signalled = self._step_complete = False

    @property
    def seconds(self) -> float:
        """Return the training time so far, including resumed runs [s]."""
        return self._previous_seconds + time.monotonic() - self._began

    @contextmanager
    def handling_signals(self) -> Iterator[None]:
        """Handle the signals, if in the main thread, and start the clock."""
        self._began = time.monotonic()
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        previous = self._install_handlers()
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _install_handlers(self) -> dict[signal.Signals, Any]:
        return {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Replace Lightning's own handlers, which can deadlock several processes; all state is restored by now."""
        self.started = True
        if signal.getsignal(signal.SIGINT) == self._on_signal:
            self._install_handlers()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._signalled:  # unlike `requested`, which may come from another process
            self.stopped = True  # within a step: the previous checkpoint is the last valid one
            raise KeyboardInterrupt
        self._signalled = self.requested = True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop if requested, unless gradients are being accumulated or a validation follows."""
        self._step_complete = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        if not _validates(trainer, batch_idx):
            self._stop(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop after the validation of a step: a checkpoint from before would skip it when resumed."""
        self._stop(trainer)

    def _stop(self, trainer: Trainer) -> None:
        if not self._step_complete:
            return
        # A signal to one process after this point takes effect in the next step.
        if trainer.strategy.reduce_boolean_decision(self.requested, all=False) and not trainer.should_stop:
            self.requested = self.stopped = True
            trainer.save_checkpoint(self._path, weights_only=False)
            trainer.should_stop = True
            trainer.limit_val_batches = 0  # else Lightning validates again before it stops
            log.info("interrupted after %d steps, see %s; resume=last continues", trainer.global_step, self._path)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Add `finished` and `seconds`."""
        checkpoint["finished"], checkpoint["seconds"] = trainer.state.finished, self.seconds

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Restore the training time; a ValueError if it is no duration."""
        self._previous_seconds = parse_plain(
            checkpoint.get("seconds", 0.0), cast(type[float], NonNegative), "the training time"
        )

    @contextmanager
    def explaining_restore(self, checkpoint: Path | None) -> Iterator[None]:
        """Convert errors before the training starts from `checkpoint` into a sentence that names the file.

        Raises:
            ValueError: the state of the training in the file is damaged.
        """
        try:
            yield
        except (OSError, MisconfigurationException):
            raise
        except Exception as error:
            if self.started or checkpoint is None:
                raise
            what = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise ValueError(f"{checkpoint} cannot be resumed: {what[:1000]}") from error


class PeriodicCheckpoint(Checkpoint):
    """Saves `last.ckpt` every `SAVE_EVERY` steps; if validation runs at that step, after it."""

    def __init__(self, checkpoints: Path) -> None:
        self._path, self._due, self._step = checkpoints / LAST, False, -1

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save if due, unless a validation follows."""
        step = trainer.global_step
        self._due, self._step = step != self._step and step % SAVE_EVERY == 0, step
        if not _validates(trainer, batch_idx):
            self._save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save if due."""
        self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        if self._due:
            self._due = False
            trainer.save_checkpoint(self._path, weights_only=False)


def _validates(trainer: Trainer, batch_idx: int) -> bool:
    every = trainer.val_check_batch
    return bool(trainer.enable_validation and every and (batch_idx + 1) % every == 0)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints atomically: a complete file replaces the previous one."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a temporary file, then rename it to `path`.

        Raises:
            OSError: it cannot be written; an existing file is unchanged.
        """
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as draft, draft.open("wb") as file:
            try:
                torch.save(checkpoint, file)
            except RuntimeError as error:
                if isinstance(error.__context__, OSError):  # the cause, such as a full disk
                    raise error.__context__ from None
                raise
            os.fsync(file.fileno())


class StepSeeding(Callback):
    """Seeds torch before every batch from the seed, the step and the rank.

    Random numbers of a step are therefore independent of validations, interruptions and resuming.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Seed torch on all devices."""
        parts = trainer.accumulate_grad_batches
        step = trainer.global_step * parts + batch_idx % parts
        numbers = np.random.SeedSequence([self._seed, step, trainer.global_rank]).generate_state(1, np.uint64)
        torch.manual_seed(int(numbers[0]))


def make_trainer(config: Mapping[str, Any], checkpoints: Path | None, *callbacks: Callback) -> Trainer:
    """Create the trainer of a config, with EMA and, if a checkpoint folder is given, logging and periodic checkpoints.

    The given callbacks run before EMA at the end of a validation, so that they use the EMA weights.

    Raises:
        ValueError: the machine lacks what the config requires, or a logger's package is missing.
    """
    _keep_freed_memory()
    all_callbacks: list[Callback] = [TrainingProgressBar(), *callbacks]
    options: dict[str, Any] = {"logger": False, "enable_checkpointing": False}
    if config["learner"]["ema"]:
        all_callbacks.append(EMA(config["learner"]["ema"]))
    if checkpoints is not None:
        all_callbacks += [Throughput(), PeriodicCheckpoint(checkpoints)]
        options = {"logger": _loggers(config, checkpoints.parent)}
    all_callbacks.append(StepSeeding(config["seed"]))  # after callbacks that may use random numbers
    try:
        node = dict(config["trainer"])
        options["precision"] = PRECISIONS[node.pop("precision")]
        trainer: Trainer = build(node, "trainer", callbacks=all_callbacks, **options)
        if isinstance(trainer.strategy, ParallelStrategy) and trainer.strategy.cluster_environment:
            # Compare the number of processes with the cluster now; Lightning would only at the start of training.
            trainer.strategy.cluster_environment.validate_settings(trainer.num_devices, trainer.num_nodes)
    except RuntimeError as error:  # a cluster started another number of processes
        raise ValueError(f"training cannot start in this environment: {error}") from error
    except (MisconfigurationException, ValueError) as error:
        names = ("accelerator", "devices", "num_nodes", "strategy", "precision")
        values = {name: config["trainer"][name] for name in names if name in config["trainer"]}
        options_text = [f"trainer.{name}={value}" for name, value in values.items() if not isinstance(value, dict)]
        raise ValueError(
            f"{' '.join(options_text)} is not available here ({error}): try trainer=cpu or trainer=auto"
        ) from error
    _require_cores(trainer)
    trainer.strategy.checkpoint_io = AtomicCheckpointIO()
    return trainer


def _require_cores(trainer: Trainer) -> None:
    """Raise a ValueError for more processes on this CPU than it has cores, unless a cluster started them.

    Two are always allowed, as the smallest training of several processes to try.
    """
    environment = getattr(trainer.strategy, "cluster_environment", None)
    external = environment is not None and environment.creates_processes_externally
    if isinstance(trainer.accelerator, CPUAccelerator) and not external and trainer.num_devices > max(cores(), 2):
        raise ValueError(
            f"trainer.devices={trainer.num_devices} asks for more processes than this machine has cores: set "
            f"trainer.devices={cores()} or fewer"
        )


@contextmanager
def explain_memory_errors(config: Mapping[str, Any]) -> Iterator[None]:
    """Convert out-of-memory errors into an explanation that names the options to lower.

    Raises:
        ValueError: the memory of the GPU or of the machine is not enough.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, (MemoryError, torch.OutOfMemoryError)) and "can't allocate memory" not in str(error):
            raise
        keys = [f"data.batch_size (now {config['data']['batch_size']})"]
        keys += [f"model.{name} (now {config['model'][name]})" for name in SIZE_KEYS if config["model"].get(name)]
        raise ValueError(
            f"training needs more memory than available: lower {', '.join(keys)}; trainer.precision=bf16 needs less, "
            "and trainer.accumulate_grad_batches=2 makes one step of two batches of half the size"
        ) from error


def restore_metrics(trainer: Trainer, checkpoint: Path) -> None:
    """Start the metrics file of a resumed training with the rows up to its checkpoint, unless they are damaged."""
    source = checkpoint.parent.parent / METRICS
    writers = [logger for logger in trainer.loggers if isinstance(logger, CSVLogger)]
    if not writers or not source.exists() or not trainer.is_global_zero:
        return
    steps = torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)["global_step"]
    try:
        rows = metric_rows(source)
    except (OSError, ValueError) as error:  # they only inform
        log.warning("the training curves begin anew: %s", error)
        return
    # Lightning starts with an empty file.
    writers[0].experiment.metrics = [row for row in rows if int(row["step"]) < steps]
    writers[0].save()


def _keep_freed_memory() -> None:
    """Keep freed memory in the process for the next step.

    Page faults after returning it to the system took 7 % of a step of `bc` on a CPU, and 12 % of `rt1_tiny`.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(MMAP_THRESHOLD, MAX_MMAP_THRESHOLD)
        library.mallopt(TRIM_THRESHOLD, -1)  # never


def _loggers(config: Mapping[str, Any], folder: Path) -> list[Logger]:
    loggers = []
    for name, node in (config["logger"] or {}).items():
        try:
            loggers.append(build(node, "logger", save_dir=str(folder)))
        except ModuleNotFoundError as error:
            raise ValueError(
                f"logger.{name} needs a package that is not installed: pip install 'vla[{name}]'"
            ) from error
    return loggers


def quiet_lightning() -> None:
    """Suppress Lightning's tips, irrelevant warnings, and its own log handlers, which duplicate lines under Hydra."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).handlers.clear()
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    # Warnings about its own callbacks and hooks, which users cannot change.
    warnings.filterwarnings("ignore", module=r"lightning\.")
    warnings.filterwarnings("ignore", "FSDP2-wrapped module .* returned a view")  # not written to here
