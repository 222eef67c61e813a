"""A training that stops and goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
import torch
import toy
from defaults import defaults_of
from lightning import Callback
from reading import windows
from small_training import CONFIG

from vla.models.learner import Learner
from vla.models.model import Model
from vla.training.checkpoints import GracefulStop
from vla.training.trainer import make_trainer, restore_metrics

STEPS, STOP = 11, 6
VALIDATED = 4  # every so many steps


def config(**trainer: Any) -> dict[str, Any]:
    defaults = {
        "accelerator": "cpu",
        "precision": "fp32",
        "max_steps": STEPS,
        "max_epochs": -1,
        "val_check_interval": VALIDATED,
        "check_val_every_n_epoch": None,
        "num_sanity_val_steps": 0,
        "log_every_n_steps": 2,
        "gradient_clip_val": 1.0,
        "enable_model_summary": False,
    }
    csv_logger = {"_target_": "lightning.pytorch.loggers.CSVLogger", "name": "", "version": ""}
    return {
        "seed": 3,
        "learner": {"ema": 0.9},
        "logger": {"csv": csv_logger},
        "trainer": {"_target_": "lightning.Trainer", **defaults, **trainer},
    }


class StopAfter(Callback):
    """Interrupts a training, as a signal would, during the batch after which so many steps are done."""

    def __init__(self, graceful_stop: GracefulStop, steps: int) -> None:
        self._graceful_stop, self._steps = graceful_stop, steps

    def on_train_batch_start(self, trainer: lightning.Trainer, *_: Any) -> None:
        self._graceful_stop.requested = trainer.global_step + 1 >= self._steps


def train(
    model: Model,
    store: Path,
    output: Path,
    stop: int | None = None,
    checkpoint: Path | None = None,
    killer: lightning.Callback | None = None,
    **trainer: Any,
) -> dict[str, Any]:
    """What the checkpoint holds that a training leaves behind."""
    lightning.seed_everything(0 if checkpoint is None else 1, verbose=False)  # what came before must not matter
    graceful_stop = GracefulStop(output / "checkpoints")
    watching = [graceful_stop, *([StopAfter(graceful_stop, stop)] if stop else []), *([killer] if killer else [])]
    made = make_trainer(config(**trainer), output / "checkpoints", *watching)
    if checkpoint:
        restore_metrics(made, checkpoint)
    options = defaults_of("learner/default", warmup_steps=3, lr=0.001)
    learner = Learner(model=model, spec=toy.SPEC, config=CONFIG, **options)
    data = windows(store, history=model.history, chunk=model.chunk, tokenize=model.text.tokenize)
    with graceful_stop.explaining_restore(checkpoint):
        made.fit(learner, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    path = output / "checkpoints/last.ckpt"
    if not graceful_stop.requested:
        made.save_checkpoint(path)
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else bool(one == other)
