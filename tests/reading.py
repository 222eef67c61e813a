"""The data module on a small store, and a model that keeps what it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import toy
from lightning import LightningModule, Trainer

from vla.data.datamodule import WindowDataModule


def windows(folder: Path, **changes: Any) -> WindowDataModule:
    settings: dict[str, Any] = {
        "spec": toy.SPEC,
        "history": 3,
        "chunk": 2,
        "seed": 1,
        "batch_size": 8,
        "validation_fraction": 0.2,
        "validation_windows": 40,
        "ahead": 2,
    }
    module = WindowDataModule(folder, **{**settings, **changes})
    module.setup()
    return module


class Seen(LightningModule):
    """Remembers the windows it was shown; its one weight depends on all of them and on their order."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[torch.Tensor] = []

    def training_step(self, batch: dict[str, Any], index: int) -> torch.Tensor:
        self.seen.append(batch["state"])
        return (self.weight - batch["state"].mean()).square().mean()

    def validation_step(self, batch: dict[str, Any], index: int) -> None:
        assert batch["action"].shape == (8, 3, 2, 3)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=0.1)


def fit(folder: Path, steps: int) -> Seen:
    model = Seen()
    trainer = Trainer(
        accelerator="cpu",
        devices=1,
        max_steps=steps,
        val_check_interval=4,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    trainer.fit(model, datamodule=windows(folder))
    return model
