"""The average of the weights: what it is, where it is used, and that it goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from fake_batch import make_batch
from lightning import Callback
from small_training import loader, make_learner, make_trainer, save

from vla.models.policy_folder import read_policy
from vla.training.ema import EMA, UPDATE_INTERVAL

DECAY = 0.9


class Watch(Callback):
    """What one weight is after every step, and in every validation."""

    def __init__(self) -> None:
        self.trained: list[torch.Tensor] = []
        self.validated: list[torch.Tensor] = []

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        self.trained.append(pl_module.model.head.weight.detach().clone())

    def on_validation_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        self.validated.append(pl_module.model.head.weight.detach().clone())


def test_it_is_the_exponential_average_of_the_steps_and_what_is_validated_and_saved(tmp_path: Path) -> None:
    batch, watch, steps = make_batch(1), Watch(), 2 * UPDATE_INTERVAL + 1
    trainer = make_trainer(steps, EMA(DECAY), watch)
    learner = make_learner(lr=1e-2, warmup_steps=0)
    trainer.fit(learner, loader(learner, [batch] * steps), loader(learner, [batch]))
    save(trainer, tmp_path, "last.ckpt", "policy")
    weights = [DECAY ** (steps - step) for step in range(UPDATE_INTERVAL, steps + 1, UPDATE_INTERVAL)]
    seen = torch.stack(watch.trained[UPDATE_INTERVAL - 1 :: UPDATE_INTERVAL])
    average = torch.einsum("n,n...->...", torch.tensor(weights) / sum(weights), seen)  # of the initial weights nothing
    torch.testing.assert_close(watch.validated[-1], average)
    torch.testing.assert_close(read_policy(tmp_path).state["head.weight"], average)
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    torch.testing.assert_close(saved["current_model_state"]["model.head.weight"], watch.trained[-1])
