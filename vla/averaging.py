"""Weights averaged over the steps of a training, which are the ones evaluated and saved."""

from __future__ import annotations

from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.distributed.checkpoint.state_dict import StateDictOptions, set_model_state_dict

from vla.models.sharding import give_back, share, whole

EVERY = 4  # steps: a pass over all weights takes as long as a twentieth of the step of a small model


class Averaging(Callback):
    """Keeps an exponential moving average of what a model learns, also where its weights are shared out.

    It takes in the weights of every fourth step, with the weight of four. A checkpoint holds the average as its
    `state_dict`, and what training goes on with as `current_model_state`.

    Args:
        decay: share of the average that a step leaves, above 0 and below 1.
    """

    def __init__(self, decay: float) -> None:
        self._decay = decay
        self._average: list[Tensor] = []  # of `_learned`; empty before the first step
        self._step = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Go on from a checkpoint, where there is one, on the device of the model."""
        self._step = trainer.global_step
        current = _learned(pl_module).values()
        self._average = [mine.to(one.device) for mine, one in zip(self._average, current, strict=False)]

    @torch.no_grad()
    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Take in the weights after the first step and every fourth one, of which there may be fewer than batches."""
        if trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        if not self._average:
            self._average = [one.clone() for one in _learned(pl_module).values()]
        elif self._step % EVERY == 0:
            current = _learned(pl_module).values()
            # A kernel for all of them, which plain tensors and shared ones cannot have together.
            torch._foreach_lerp_([*map(share, self._average)], [*map(share, current)], 1 - self._decay**EVERY)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Validate the average."""
        self._swap(pl_module)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Go on with what is trained."""
        self._swap(pl_module)

    @torch.no_grad()
    def _swap(self, module: LightningModule) -> None:
        for mine, other in zip(self._average, _learned(module).values(), strict=False):
            kept = mine.clone()
            mine.copy_(other)
            other.copy_(kept)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Save the average in place of what is trained, and that beside it."""
        if not self._average:
            return
        current = checkpoint["state_dict"]
        average = {name: whole(one) for name, one in zip(_learned(pl_module), self._average, strict=True)}
        checkpoint["current_model_state"] = current
        checkpoint["state_dict"] = {name: average.get(name, value) for name, value in current.items()}

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Take the average out of the model, which has got the `state_dict` by now, and put in what is trained."""
        self._average = [one.detach().clone() for one in _learned(pl_module).values()]
        if "current_model_state" in checkpoint:
            options = StateDictOptions(full_state_dict=True)
            set_model_state_dict(pl_module, checkpoint["current_model_state"], options=options)


def _learned(module: LightningModule) -> dict[str, Tensor]:
    """Name → everything in a module that training changes, of shared weights the share of this process."""
    give_back(module)
    weights = {name: weight for name, weight in module.named_parameters() if weight.requires_grad}
    return weights | {name: buffer for name, buffer in module.named_buffers() if buffer.is_floating_point()}
