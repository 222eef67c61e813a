"""Exponential moving average of the weights; the averaged weights are evaluated and saved."""

from __future__ import annotations

from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.distributed.checkpoint.state_dict import StateDictOptions, set_model_state_dict

from vla.models.fsdp import full_tensor, local_shard, reshard

UPDATE_INTERVAL = 4  # steps; an update takes a twentieth of the step of a small model


class EMA(Callback):
    """Exponential moving average (EMA) of the weights and floating-point buffers, also under FSDP.

    It is updated every fourth step with `decay**4` and bias-corrected for its initial value. A checkpoint holds
    the average as its `state_dict`, and the weights in training as `current_model_state`.

    Lightning's `EMAWeightAveraging` does not work under FSDP, loses the weights in training at the end, and updates
    several times more slowly, weight by weight.

    Args:
        decay: decay per step, above 0 and below 1.
    """

    def __init__(self, decay: float) -> None:
        self._decay = decay
        self._average: list[Tensor] = []  # of `_weights_of`; empty before the first step
        self._step = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Move an average from a checkpoint to the device of the model."""
        self._step = trainer.global_step
        weights = _weights_of(pl_module).values()
        self._average = [average.to(weight.device) for average, weight in zip(self._average, weights, strict=False)]

    @torch.no_grad()
    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Update after the first optimiser step and every fourth; a step may take several batches."""
        if trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        if not self._average:
            self._average = [weight.clone() for weight in _weights_of(pl_module).values()]
        elif self._step % UPDATE_INTERVAL == 0:
            weights = _weights_of(pl_module).values()
            # Bias correction, as for Adam's moments (arXiv 1412.6980, section 3).
            share = (1 - self._decay**UPDATE_INTERVAL) / (1 - self._decay**self._step)
            # One fused kernel, which cannot mix plain and sharded tensors.
            torch._foreach_lerp_([*map(local_shard, self._average)], [*map(local_shard, weights)], share)

    @torch.no_grad()
    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Exchange the average and the weights in training."""
        for average, weight in zip(self._average, _weights_of(pl_module).values(), strict=False):
            backup = average.clone()
            average.copy_(weight)
            weight.copy_(backup)

    on_validation_epoch_end = on_validation_epoch_start

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Save the average as `state_dict` and the weights in training as `current_model_state`."""
        if not self._average:
            return
        training_state = checkpoint["state_dict"]
        average = {name: full_tensor(value) for name, value in zip(_weights_of(pl_module), self._average, strict=True)}
        checkpoint["current_model_state"] = training_state
        checkpoint["state_dict"] = {name: average.get(name, value) for name, value in training_state.items()}

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Read the average from the loaded model, then load the weights in training into it."""
        self._average = [weight.detach().clone() for weight in _weights_of(pl_module).values()]
        if "current_model_state" in checkpoint:
            options = StateDictOptions(full_state_dict=True)
            set_model_state_dict(pl_module, checkpoint["current_model_state"], options=options)


def _weights_of(module: LightningModule) -> dict[str, Tensor]:
    """Return name → trained parameters and floating-point buffers of a module, sharded ones as they are."""
    reshard(module)
    weights = {name: weight for name, weight in module.named_parameters() if weight.requires_grad}
    return weights | {name: buffer for name, buffer in module.named_buffers() if buffer.is_floating_point()}
