"""The Lightning module that trains a model: optimiser, schedule, logging and checkpoint metadata."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, Literal

import torch
from lightning import Callback, LightningModule
from lightning.pytorch.callbacks import LambdaCallback
from torch import Tensor, distributed, nn
from torchmetrics import MeanMetric

from vla.io.errors import UserError
from vla.io.printable import display_unit
from vla.io.types import Natural, NonNegative, Positive, Rate
from vla.models.compilation import prepare_compilation
from vla.models.fsdp import gather_weights, local_shard, shard
from vla.models.layers import Batch
from vla.models.lora import LoRA
from vla.models.model import Model
from vla.models.recomputation import recompute_layers
from vla.models.trunk import evaluate_frozen, trunks
from vla.spec import Spec

CHECK_FINITE_EVERY = 50  # steps
NEVER = torch.iinfo(torch.int64).max  # first step with a non-finite loss, if there was none


class Learner(LightningModule):
    """AdamW on the loss of a model, with warm-up and a learning-rate schedule.

    Args:
        lr: peak learning rate.
        weight_decay: of matrices and filters; not of biases, norms and embeddings.
        warmup_steps: number of steps of linear warm-up from 0.
        schedule: "cosine" decays to 0 at the last step of the trainer; "constant" does not decay.
        compile: compile the model with torch.compile.
        ema: decay per step of the EMA weights, which are the ones evaluated and saved; 0 disables EMA.
        rates: part of the model, such as context or context.image, → factor of its learning rate.
        frozen: parts that are not trained, except for LoRA factors in them: neither their weights nor their running
            statistics, such as those of batch normalisation, change.
        lora: low-rank adaptation of linear maps; None: there is none.
        checkpointing: recompute activations within layers in the backward pass instead of keeping them.
        model: the model to train.
        spec: observation and action spaces; saved with every checkpoint.
        config: the resolved configuration as plain dicts and lists; saved with every checkpoint.

    Raises:
        UserError: `rates` or `frozen` name no part of the model, or nothing is left to train.
    """

    def __init__(
        self,
        lr: Positive,
        weight_decay: NonNegative,
        warmup_steps: Natural,
        schedule: Literal["cosine", "constant"],
        compile: bool,
        ema: Rate,
        rates: dict[str, Positive] | None,
        frozen: list[str],
        lora: LoRA | None,
        checkpointing: bool,
        *,
        model: Model,
        spec: Spec,
        config: dict[str, Any],
    ) -> None:
        super().__init__()
        self.model, self._spec, self._config = model, spec, config
        self._lr, self._weight_decay, self._warmup, self._schedule = lr, weight_decay, warmup_steps, schedule
        self._compile, self._rates, self._frozen = compile, rates or {}, frozen
        self._saved_precision: tuple[bool, str] | None = None  # flash attention and precision outside training
        self._non_finite_step: Tensor | None = None  # () on the device of the loss
        self.errors = nn.ModuleList(MeanMetric() for _ in spec.action)
        self._scale = lora.alpha / lora.rank if lora else 1.0
        if lora:
            lora.inject(model)
        if checkpointing:
            recompute_layers(model)
        self._groups()  # refuses unknown names early, and freezes parts before the model is sharded
        self._trunks, self._figures = trunks(model), dict[str, float]()
        modules = dict(model.named_modules())
        for name in modules.keys() & {*self._trunks, *frozen}:  # what is frozen may also be a single parameter
            evaluate_frozen(modules[name])

    def _groups(self) -> list[dict[str, Any]]:
        return self.model.parameter_groups(self._lr, self._weight_decay, self._rates, self._frozen)

    def configure_model(self) -> None:
        """Compile the model in place, which keeps names in checkpoints; shard it if the strategy has a device mesh."""
        if self._compile:
            prepare_compilation()
            self.model.compile()
            self._compile = False  # Lightning may call this hook again
        if self.device_mesh is not None:
            shard(self.model, self.device_mesh)

    def on_fit_start(self) -> None:
        """Disable flash attention on a CPU, as its bfloat16 backward is very slow; enable TensorFloat-32 on a GPU."""
        self._saved_precision = torch.backends.cuda.flash_sdp_enabled(), torch.get_float32_matmul_precision()
        if self.device.type == "cpu":
            torch.backends.cuda.enable_flash_sdp(False)
        else:
            torch.set_float32_matmul_precision("high")

    def teardown(self, stage: str) -> None:
        """Undo what `on_fit_start` set, so that an evaluation in this process gives the same results as in another."""
        if self._saved_precision is not None:
            _set_precision(*self._saved_precision)
            self._saved_precision = None

    def configure_callbacks(self) -> list[Callback]:
        """Return a callback that calls `teardown` after an error, when Lightning does not but a sweep continues."""
        return [LambdaCallback(on_exception=lambda *_: self.teardown("fit"))]

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Within the context, compute exactly what a process that does not train would: see `on_fit_start`."""
        training_precision = torch.backends.cuda.flash_sdp_enabled(), torch.get_float32_matmul_precision()
        if self._saved_precision is not None:
            _set_precision(*self._saved_precision)
        try:
            with torch.compiler.set_stance("force_eager"):  # compiled for another shape than that of one window
                yield
        finally:
            _set_precision(*training_precision)

    @torch.no_grad()
    def on_train_start(self) -> None:
        """Give restored optimiser state the strides of its parameter.

        Fused AdamW requires it, and FSDP saves everything contiguous.
        """
        for optimizer in self.trainer.optimizers:
            for weight, state in optimizer.state.items():
                for name, value in state.items():
                    if value.shape == weight.shape and local_shard(value).stride() != local_shard(weight).stride():
                        state[name] = torch.empty_like(weight).copy_(value)

    def configure_optimizers(self) -> Any:
        """Create AdamW on the model's parameter groups, with the schedule."""
        optimizer = torch.optim.AdamW(self._groups(), lr=self._lr, fused=True)
        # If this flag is set, Lightning assumes scaled gradients and never clips them.
        optimizer._step_supports_amp_scaling = False
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._lr_factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _lr_factor(self, step: int) -> float:
        """Return the learning rate of a step as a fraction of its peak."""
        if step < self._warmup:
            return (step + 1) / (self._warmup + 1)
        if self._schedule == "constant":
            return 1.0
        total = float(self.trainer.estimated_stepping_batches)  # infinite without a limit of steps
        progress = (step - self._warmup) / max(total - self._warmup, 1)
        return 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Apply the transforms of the model to a batch on its device."""
        return self.model.transforms(batch)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of a batch, which is augmented here: after `StepSeeding` and outside the compiled part.

        Raises:
            UserError: the loss of this step or an earlier one is not finite.
        """
        # Lightning counts the last step of a finished training once more when that goes on, and labels curves with it.
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self.global_step
        losses = self.model.loss(self.model.augment(batch))
        self._record_finite(losses["loss"].detach())
        interval = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        if interval and (self.global_step + 1) % interval == 0:  # only when loggers write
            for name, value in losses.items():
                self.log(f"train/{name}", value.detach())
        return losses["loss"]

    def _record_finite(self, loss: Tensor) -> None:
        """Record on the device whether the loss is finite; reading it in every step would synchronise a GPU."""
        step = torch.where(loss.isfinite(), NEVER, self.global_step)
        self._non_finite_step = step if self._non_finite_step is None else torch.minimum(self._non_finite_step, step)
        if self.global_step % CHECK_FINITE_EVERY == 0:
            self._require_finite()

    def _require_finite(self) -> None:
        if self._non_finite_step is not None and distributed.is_available() and distributed.is_initialized():
            # Otherwise one process would stop while the others wait for it.
            distributed.all_reduce(self._non_finite_step, op=distributed.ReduceOp.MIN)
        if self._non_finite_step is not None and (step := int(self._non_finite_step)) != NEVER:
            raise UserError(
                f"the loss is not a finite number at step {step}: lower learner.lr (now {self._lr}), raise "
                "learner.warmup_steps, or clip harder with trainer.gradient_clip_val; the last checkpoint is kept"
            )

    def on_train_end(self) -> None:
        """Check the last losses.

        Raises:
            UserError: a loss was not finite.
        """
        self._require_finite()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Log the losses, and the error of the predicted actions of the newest frame per component."""
        for name, value in self.model.loss(batch).items():
            self.log(f"val/{name}", value, batch_size=len(batch["action"]), sync_dist=True)
        seen = {name: batch[name] for name in ("rgb", "state", "present", "text")}  # no more than a policy gets
        with gather_weights(self.model):
            actions = self.model.predict(seen).actions
        error = (actions - batch["action"][:, -1]).abs()[batch["valid"][:, -1]]  # (N, D)
        for index, (name, unit) in enumerate(zip(self._spec.action, self._spec.units, strict=True)):
            factor, unit_name = display_unit(unit)
            metric = self.errors[index]
            assert isinstance(metric, MeanMetric)
            metric.update(error[:, index] * factor)
            self.log(f"val/error_{name}{f'_{unit_name}' if unit_name else ''}", metric)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add config, spec, trunks, LoRA's scale and the last validation's figures, which load without running code.

        Raises:
            UserError: a loss was not finite.
        """
        self._require_finite()
        checkpoint["config"], checkpoint["spec"] = self._config, self._spec.to_dict()
        checkpoint["trunks"] = {name: asdict(source) for name, source in self._trunks.items()}
        checkpoint["lora_scale"] = self._scale
        metrics = self.trainer.callback_metrics.items()
        figures = {name: float(value) for name, value in metrics if name.startswith("val/")}
        checkpoint["figures"] = self._figures = figures or self._figures

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the figures of the last validation, for a policy that is saved before the next one."""
        self._figures = checkpoint["figures"]


def _set_precision(flash: bool, precision: str) -> None:
    torch.backends.cuda.enable_flash_sdp(flash)
    torch.set_float32_matmul_precision(precision)
