"""Checkpoints of a training, saved atomically, periodically and on interruption."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.strategies import ModelParallelStrategy, Strategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from vla.io.errors import UserError, counted
from vla.io.files import atomic_path
from vla.models.checkpoint import read_content
from vla.models.policy_writing import write_policy
from vla.runs.folder import LAST

log = logging.getLogger(__name__)

SAVE_EVERY = 500  # steps


class GracefulStop(Checkpoint):
    """Saves `last.ckpt` every `SAVE_EVERY` steps, and stops a training at signals.

    At the first SIGINT or SIGTERM it saves and stops after the current step, in all processes together; at the second
    it stops at once. A validation that is due after the step comes first: a checkpoint saved before it would skip it.
    As a Lightning `Checkpoint` it runs after all other callbacks. It saves `finished` and the training time, `seconds`.
    """

    def __init__(self, checkpoints: Path) -> None:
        self._path, self._previous_seconds, self._start_time = checkpoints / LAST, 0.0, time.monotonic()
        self.requested = self.stopped = self.started = self._signalled = self._step_complete = False

    @property
    def seconds(self) -> float:
        """Return the training time so far, including resumed runs [s]."""
        return self._previous_seconds + time.monotonic() - self._start_time

    @contextmanager
    def handling_signals(self) -> Iterator[None]:
        """Handle the signals, if in the main thread, and start the clock."""
        self._start_time = time.monotonic()
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        previous_handlers = self._install_handlers()
        try:
            yield
        finally:
            for number, handler in previous_handlers.items():
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
        """Save and stop as due, unless gradients are being accumulated or a validation follows."""
        self._step_complete = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        interval = trainer.val_check_batch  # counted from the start of the training
        validates = trainer.enable_validation and interval and (trainer.fit_loop.total_batch_idx + 1) % interval == 0
        if not validates:
            self.on_validation_end(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save and stop as due."""
        if not self._step_complete:
            return
        # A signal to one process after this point takes effect in the next step.
        if trainer.strategy.reduce_boolean_decision(self.requested, all=False) and not trainer.should_stop:
            self.requested = self.stopped = True
            trainer.save_checkpoint(self._path, weights_only=False)
            trainer.should_stop = True
            trainer.limit_val_batches = 0  # else Lightning validates again before it stops
            log.info("interrupted after %s, saved in %s", counted(trainer.global_step, "step"), self._path)
        elif trainer.global_step % SAVE_EVERY == 0:
            trainer.save_checkpoint(self._path, weights_only=False)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Add `finished` and `seconds`."""
        checkpoint["finished"], checkpoint["seconds"] = trainer.state.finished, self.seconds

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Restore the training time."""
        self._previous_seconds = checkpoint["seconds"]

    @contextmanager
    def explaining_restore(self, checkpoint: Path | None) -> Iterator[None]:
        """Convert errors before the training starts from `checkpoint` into a sentence that names the file.

        Raises:
            UserError: the state of the training in the file is damaged.
        """
        try:
            yield
        except (OSError, MisconfigurationException):
            raise
        except Exception as error:
            if self.started or checkpoint is None:
                raise
            reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise UserError(f"{checkpoint} cannot be resumed: {reason[:1000]}") from error


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints atomically, as a policy unless the path ends in `.ckpt`, and reads them as plain data."""

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        """Return plain values and tensors, on the CPU. Raises as `read_content` does."""
        return read_content(Path(path))

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a temporary file or folder, then rename it to `path`.

        Raises:
            OSError: it cannot be written; an existing one is unchanged.
        """
        target = Path(path)
        if target.suffix != Path(LAST).suffix:
            write_policy(target, checkpoint)
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as draft, draft.open("wb") as file:
            try:
                torch.save(checkpoint, file)
            except RuntimeError as error:
                if isinstance(error.__context__, OSError):  # the cause, such as a full disk
                    raise error.__context__ from None
                raise
            os.fsync(file.fileno())


class Sharded(ModelParallelStrategy):
    """Lightning's FSDP2 strategy, but with checkpoints as single files and policies as folders, as without sharding."""

    def __init__(self) -> None:
        super().__init__(save_distributed_checkpoint=False)

    def save_checkpoint(self, checkpoint: dict[str, Any], filepath: Any, storage_options: Any = None) -> None:
        """Write the state gathered from all processes; Lightning would refuse to replace the folder of a policy."""
        Strategy.save_checkpoint(self, checkpoint, filepath, storage_options)
