"""Small learners, trainers and batches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
from defaults import defaults_of
from fake_batch import make_bc, with_text
from torch.utils.data import DataLoader
from toy import SPEC

from vla.models.learner import Learner
from vla.models.model import Model
from vla.training.checkpoints import AtomicCheckpointIO

MODEL = {"_target_": "vla.models.bc.BC", "shift": [0, 0]}

CONFIG: dict[str, Any] = {"task": {}, "tokenizer": {}, "model": MODEL, "seed": 0}


def make_learner(model: Model | None = None, **options: Any) -> Learner:
    arguments = defaults_of("learner/default", **{"lr": 1e-3, **options})
    return Learner(**arguments, model=model or make_bc(), spec=SPEC, config=CONFIG)


def make_trainer(steps: int, *callbacks: lightning.Callback, precision: Any = "32-true") -> lightning.Trainer:
    return lightning.Trainer(
        accelerator="cpu",
        max_steps=steps,
        precision=precision,
        logger=False,
        callbacks=list(callbacks),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )


def loader(learner: Learner, batches: list[dict[str, Any]]) -> DataLoader[Any]:
    """Loader of batches, with their sentences as tokens."""
    return DataLoader([with_text(learner.model, batch) for batch in batches], batch_size=None)  # type: ignore[arg-type]


def save(trainer: lightning.Trainer, folder: Path, *names: str) -> None:
    """Save checkpoints, whose names end in .ckpt, and policies."""
    trainer.strategy.checkpoint_io = AtomicCheckpointIO()
    for name in names:
        trainer.save_checkpoint(folder / name, weights_only=False)


def fit(learner: Learner, batch: dict[str, Any], steps: int, **options: Any) -> lightning.Trainer:
    trainer = make_trainer(steps, **options)
    trainer.fit(learner, loader(learner, [batch] * steps), loader(learner, [batch]))
    return trainer
