"""The learner: how a model's weights follow from batches; Lightning's trainer decides where and how fast."""

# B batch, T frames, k action chunk, D action components, K bins

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torchmetrics import MeanMetric

from vla.models.image_tokenizer import RandomShift
from vla.models.model import Model
from vla.models.sharding import gathered, shard, share
from vla.spec import Spec
from vla.types import Natural, NonNegative, Positive, Rate

Batch = dict[str, Any]

LOOK_EVERY = 50  # steps, at whether all losses were finite
FINITE = torch.iinfo(torch.int64).max  # the step at which the loss was not, as long as it always was

READABLE = {"m": (1000.0, "mm"), "rad": (180 / math.pi, "deg"), "1": (1.0, "")}  # unit → factor and unit of the logs


class Learner(LightningModule):
    """AdamW on a model's own loss, with warm-up and a schedule over the trainer's steps.

    Args:
        lr: largest learning rate.
        weight_decay: of matrices and filters; biases, norms and embeddings are left alone.
        warmup_steps: steps in which the learning rate rises evenly from 0.
        schedule: "cosine" falls to 0 at the trainer's last step, "constant" stays.
        compile: compile the model with torch.compile.
        ema: decay per step of the averaged weights, which are the ones evaluated and saved; 0 keeps no average.
        model: what learns.
        spec: what a step looks like; saved with every checkpoint.
        config: the resolved configuration as plain dicts and lists; saved with every checkpoint.
    """

    def __init__(
        self,
        lr: Positive = 1e-3,
        weight_decay: NonNegative = 0.01,
        warmup_steps: Natural = 100,
        schedule: Literal["cosine", "constant"] = "cosine",
        compile: bool = False,
        ema: Rate = 0.998,
        *,
        model: Model,
        spec: Spec,
        config: dict[str, Any],
    ) -> None:
        super().__init__()
        if not (lr > 0 and weight_decay >= 0 and 0 <= ema < 1):
            raise ValueError(
                f"learner.lr={lr} must be above 0, learner.weight_decay={weight_decay} at least 0, "
                f"learner.ema={ema} from 0 up to 1"
            )
        self.model, self._spec, self._config = model, spec, config
        self._lr, self._weight_decay, self._warmup, self._schedule = lr, weight_decay, warmup_steps, schedule
        self._compile, self.ema = compile, ema
        self._broken: Tensor | None = None  # () the first step whose loss is not finite, where the loss is
        self.errors = nn.ModuleList(MeanMetric() for _ in spec.action)

    def configure_model(self) -> None:
        """Compile in place, so that the names in a checkpoint stay those of the model; share its weights out where
        the trainer's strategy asks for it."""
        if self._compile:
            for part in self.model.modules():
                if isinstance(part, RandomShift):
                    part.forward = torch.compiler.disable(part.forward)  # type: ignore[method-assign]
            self.model.compile()
            self._compile = False  # Lightning may call this hook again
        if self.device_mesh is not None:
            shard(self.model, self.device_mesh)

    def on_fit_start(self) -> None:
        """On a CPU, do without flash attention: its backward pass in bfloat16 is pathologically slow there. On a GPU,
        let 32-bit matrix products use tensor cores, as convolutions do by default."""
        if self.device.type == "cpu":
            torch.backends.cuda.enable_flash_sdp(False)
        else:
            torch.set_float32_matmul_precision("high")

    @torch.no_grad()
    def on_train_start(self) -> None:
        """Lay what the optimiser was given by a checkpoint out in memory like the weights: its one kernel for all of
        them relies on it, and processes that share weights out leave everything in the usual order."""
        for optimizer in self.trainer.optimizers:
            for weight, state in optimizer.state.items():
                for name, value in state.items():
                    if value.shape == weight.shape and share(value).stride() != share(weight).stride():
                        state[name] = torch.empty_like(weight).copy_(value)

    def configure_optimizers(self) -> Any:
        """AdamW, decaying only what has more than one dimension and is no embedding."""
        embeddings = {id(m.weight) for m in self.model.modules() if isinstance(m, nn.Embedding)}
        trained = [p for p in self.model.parameters() if p.requires_grad]
        decayed = [p for p in trained if p.dim() > 1 and id(p) not in embeddings]
        others = [p for p in trained if p.dim() <= 1 or id(p) in embeddings]
        groups = [{"params": decayed, "weight_decay": self._weight_decay}, {"params": others, "weight_decay": 0.0}]
        # One kernel per step instead of a dozen per weight; where gradients are scaled, Lightning would refuse to clip.
        optimizer = torch.optim.AdamW(groups, lr=self._lr, fused=self.trainer.precision != "16-mixed")
        if self.trainer.precision == "bf16-mixed":  # takes it for scaled as well, by this mark
            optimizer._step_supports_amp_scaling = False
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._share)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _share(self, step: int) -> float:
        """Share of the largest learning rate in a step."""
        if step < self._warmup:
            return (step + 1) / (self._warmup + 1)
        if self._schedule == "constant":
            return 1.0
        total = float(self.trainer.estimated_stepping_batches)
        done = (step - self._warmup) / max(total - self._warmup, 1)
        return 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Move all but the sentences, each of which Lightning would look into for what it could move."""
        numbers = {name: value for name, value in batch.items() if name != "instruction"}
        moved: Batch = super().transfer_batch_to_device(numbers, device, dataloader_idx)
        return {**moved, "instruction": batch["instruction"]}

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Add what the text encoder reads: sentences become numbers outside the part that compiles."""
        return self.prepare(batch)

    def prepare(self, batch: Batch) -> Batch:
        """The batch with what the text encoder reads of its instructions as `text`."""
        return {**batch, "text": self.model.text.tokenize(batch["instruction"]).to(batch["proprio"].device)}

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a batch.

        Raises:
            ValueError: the loss of this step or of one before is not a finite number.
        """
        losses = self.model.loss(batch)
        self._watch(losses["loss"].detach())
        every = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        if every and (self.global_step + 1) % every == 0:  # when loggers take it; to keep it for them takes time, too
            for name, value in losses.items():
                self.log(f"train/{name}", value.detach())
        return losses["loss"]

    def _watch(self, loss: Tensor) -> None:
        """Note, beside the loss, whether it is finite: to look at it in every step would stop a GPU as often."""
        step = torch.where(loss.isfinite(), FINITE, self.global_step)
        self._broken = step if self._broken is None else torch.minimum(self._broken, step)
        if self.global_step % LOOK_EVERY == 0:
            self._require_finite()

    def _require_finite(self) -> None:
        if self._broken is not None and (step := int(self._broken)) != FINITE:
            raise ValueError(
                f"the loss is not a finite number at step {step}: lower learner.lr (now {self._lr}), raise "
                "learner.warmup_steps, or clip harder with trainer.gradient_clip_val; the last checkpoint is kept"
            )

    def on_train_end(self) -> None:
        """Let no loss go unseen.

        Raises:
            ValueError: one was not a finite number.
        """
        self._require_finite()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """The losses, and the error of the actions that would be executed after the newest frame, per component."""
        for name, value in self.model.loss(batch).items():
            self.log(f"val/{name}", value, batch_size=len(batch["action"]), sync_dist=True)
        with gathered(self.model):
            actions = self.model.predict(batch).actions
        error = (actions - batch["action"][:, -1]).abs()[batch["valid"][:, -1]]  # (N, D)
        for index, (name, unit) in enumerate(zip(self._spec.action, self._spec.units, strict=True)):
            factor, readable = READABLE[unit]
            metric = self.errors[index]
            assert isinstance(metric, MeanMetric)
            metric.update(error[:, index] * factor)
            self.log(f"val/error_{name}{f'_{readable}' if readable else ''}", metric)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """A checkpoint says what made it, in plain dicts that load without running code.

        Raises:
            ValueError: a loss was not a finite number, nor are the weights since.
        """
        self._require_finite()
        checkpoint["config"], checkpoint["spec"] = self._config, self._spec.to_dict()
