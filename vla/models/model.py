"""Base classes of models, which map a batch of windows to actions, and layers that they share.

Shapes: B batch, T history frames, k action chunk, D action components, K bins, S truth scalars, P state components.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Inherited, NonNegative, Steps, Width
from vla.models.kinematics import ForwardKinematics
from vla.models.text.ngrams import TextEncoder
from vla.models.tokenizers.tokenizer import ActionTokenizer, PerComponent
from vla.spec import Spec

Batch = dict[str, Any]


class RunningNormalizer(nn.Module):
    """Normalisation to zero mean and unit variance by running statistics, which are saved in checkpoints.

    Unlike batch normalisation it never uses the statistics of the current batch alone. Statistics are reduced over all
    processes of a training.

    Args:
        width: number of components.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    MIN_STD = 1e-3  # a component that is constant in the data must not explode when it moves
    LIMIT = 5.0  # standard deviations; values are clipped to it

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("variance", torch.zeros(width))

    @property
    def std(self) -> Tensor:
        """Return the standard deviations, (width,)."""
        return self.variance.sqrt().clamp(min=self.MIN_STD)

    def forward(self, values: Tensor, present: Tensor) -> Tensor:
        """Normalise (B, T, width) values where the (B, T) bool `present` is true; the others become 0."""
        if self.training:
            self._update(values.detach(), present.unsqueeze(-1).to(values.dtype))
        normalized = ((values - self.mean) / self.std).clamp(-self.LIMIT, self.LIMIT)
        return normalized * present.unsqueeze(-1)

    def _update(self, values: Tensor, weight: Tensor) -> None:
        added = _sum_over_processes(weight.sum())
        total = (self.count + added).clamp(min=1)
        mean = _sum_over_processes((values * weight).sum((0, 1))) / added.clamp(min=1)
        squares = _sum_over_processes(((values - mean).square() * weight).sum((0, 1)))
        # Parallel variance algorithm (Chan et al. 1979).
        shift = mean - self.mean
        between = shift.square() * self.count * added / total
        self.variance.copy_((self.variance * self.count + squares + between) / total)
        self.mean.add_(shift * added / total)
        self.count.add_(added)


def mean_where(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of values where the bool mask of the same shape is true; 0 if it is so nowhere."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


def _sum_over_processes(tensor: Tensor) -> Tensor:
    """Sum a tensor in place over all processes of a training."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.all_reduce(tensor)
    return tensor


class Prediction(NamedTuple):
    """Predicted actions after the newest frame of each window."""

    actions: Tensor  # (B, k, D) float32, in the units of the spec, not clipped to its bounds
    probabilities: Tensor | None = None  # (B, k, D, K) float32, for tokenizers with one token per component


class Model(nn.Module, ABC):
    """A policy network: batch of windows → actions.

    A batch is a dict:
        rgb: camera → (B, T, H, W, 3) uint8; state: (B, T, P) float32; present: (B, T) bool, false for padding;
        text: from `model.text.tokenize`. For training also action: (B, T, k, D) float32; valid: (B, T, k) bool, the
        loss mask, true for a prefix of each chunk; unperturbed: (B, T) bool, false where a perturbation falls in the
        chunk; truth: (B, T, S) float32. For generative models optionally noise: (B, k, D) float32, standard normal.

    A policy executes the first `execute` of the k actions before it predicts again.

    Args:
        text: factory of the text encoder, called with `width`.
        text_width: length of the instruction vector.
        chunk: k, number of actions predicted for a frame.
        width: hidden width; in a transformer that of a token.
        auxiliary: loss weight of the head that predicts the simulator state, used in training only; 0 omits it.
        execute: number of the k actions that a policy executes before it predicts again; None: all.
        spec: observation and action spaces.
        tokenizer: converts between actions and tokens, and gives the action bounds.

    Raises:
        UserError: `execute` exceeds `chunk`.
    """

    history = 1  # T, number of frames in the input
    uses_tokens = True  # whether actions are predicted as tokens; else as numbers, scaled by the tokenizer's bounds
    TRUTH_INPUT = 1  # length of the features that the auxiliary head reads [width]

    pose: Tensor  # indices of the state components that are not rates
    joints: Tensor  # indices of the joint positions in the state

    def __init__(
        self,
        text: Callable[..., TextEncoder],
        text_width: Width,
        chunk: Steps,
        width: Width,
        auxiliary: NonNegative,
        execute: Steps | None = None,
        *,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        super().__init__()
        self.chunk, self.execute = chunk, chunk if execute is None else execute
        if self.execute > chunk:
            raise UserError(f"model.execute={execute} is more than the model.chunk={chunk} actions that are predicted")
        self.width, self.auxiliary, self.spec, self.tokenizer = width, auxiliary, spec, tokenizer
        self.text = text(width=text_width)
        chain = spec.robot.chain if spec.robot else ()
        self.kinematics = ForwardKinematics(chain) if chain else None
        self.register_buffer("pose", torch.tensor(spec.pose, dtype=torch.long), persistent=False)
        joints = spec.indices(spec.robot.joints) if spec.robot else []
        self.register_buffer("joints", torch.tensor(joints, dtype=torch.long), persistent=False)
        self.robot_state_width = len(spec.pose) + (ForwardKinematics.WIDTH if chain else 0)
        self.truth_head: nn.Linear | None = None
        if auxiliary > 0 and spec.truth_size > 0:
            self.truth_head = nn.Linear(self.TRUTH_INPUT * width, spec.truth_size)
            self.truth_scale = RunningNormalizer(spec.truth_size)

    def robot_state(self, batch: Batch) -> Tensor:
        """Return (B, T, robot_state_width): the state without rates, and the pose of the tool if kinematics are known.

        Velocities are left out because a policy that observes them learns that an arm at rest stays at rest.
        """
        pose = batch["state"].index_select(-1, self.pose)
        if self.kinematics is None:
            return pose
        return torch.cat([pose, self.kinematics(batch["state"].index_select(-1, self.joints))], -1)

    def augment(self, batch: Batch) -> Batch:
        """Return a training batch with random changes to its images; this part is not compiled."""
        return batch

    def encode(self, batch: Batch) -> Tensor | None:
        """Return tokens of each frame, (B, T, N, E), to cache and pass to `forward` as "tokens" instead of images.

        None for a model without such a cache.
        """
        return None

    def sample_noise(self, random: torch.Generator) -> Tensor | None:
        """Sample the "noise" of one prediction, (1, k, D); None for a deterministic model."""
        return None

    def predict_truth(self, features: Tensor) -> dict[str, Tensor]:
        """Return truth: (B, T', S), normalised, given (B, T', …) features; nothing without an auxiliary head."""
        return {} if self.truth_head is None else {"truth": self.truth_head(features)}

    def scaled(self, action: Tensor) -> Tensor:
        """Scale (…, D) actions so that the bounds of the tokenizer become -1 and 1; nothing is clipped."""
        low, high = self.tokenizer.low, self.tokenizer.high
        return 2 * (action - low) / (high - low) - 1

    def unscaled(self, scaled: Tensor) -> Tensor:
        """Invert `scaled`: (…, D) numbers to float32 actions."""
        low, high = self.tokenizer.low, self.tokenizer.high
        return (scaled.float() + 1) / 2 * (high - low) + low

    @abstractmethod
    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return the inputs of `action_loss` for the last T' of the T frames; this part is compiled.

        Also the result of `predict_truth`.
        """

    @abstractmethod
    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the scalar `action_loss` given the output of `forward`, and other values to log."""

    @abstractmethod
    def predict(self, batch: Batch) -> Prediction:
        """Predict the actions after the newest present frame; later padding must have no effect.

        Requires "present", "text", and the images and states or the "tokens" of all frames.
        """

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the scalar `loss` to minimise, and its parts by name."""
        output = self(batch)
        losses = self.action_loss(output, batch)
        losses["loss"] = losses["action_loss"]
        if self.truth_head is not None:
            frames = output["truth"].shape[1]
            truth = batch["truth"][:, -frames:]
            known = batch["present"][:, -frames:] & truth.isfinite().all(-1)
            target = self.truth_scale(truth.nan_to_num(), known)
            error = (output["truth"].float() - target).square().mean(-1)  # (B, T')
            losses["truth_loss"] = mean_where(error, known)
            losses["loss"] = losses["loss"] + self.auxiliary * losses["truth_loss"]
        return losses


class TokenModel(Model):
    """A model that predicts logits of every bin of every action component in one pass.

    Its `forward` returns logits: (B, T', k, D, K).
    """

    tokenizer: PerComponent

    def __init__(self, *, tokenizer: PerComponent, **inherited: Inherited) -> None:
        super().__init__(tokenizer=tokenizer, **inherited)

    @property
    def logits_shape(self) -> tuple[int, int, int]:
        """Return k, D and K."""
        return self.chunk, len(self.spec.action), self.tokenizer.bins

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the tokenizer's loss over all frames and, outside training, the token accuracy."""
        logits = output["logits"]
        frames = logits.shape[1]
        action, valid = batch["action"][:, -frames:], batch["valid"][:, -frames:]
        losses = {"action_loss": mean_where(self.tokenizer.cross_entropy(logits.float(), action).mean(-1), valid)}
        if not self.training:
            correct = logits.argmax(-1) == self.tokenizer.encode(action)  # (B, T', k, D)
            losses["token_accuracy"] = correct[valid].float().mean()
        return losses

    def predict(self, batch: Batch) -> Prediction:
        """Decode the logits of the newest frame."""
        frame = newest(batch["present"])
        logits = self(batch)["logits"]
        if logits.shape[1] != batch["present"].shape[1]:
            raise UserError(f"{type(self).__name__}.forward must return logits for every frame of its history")
        logits = logits[torch.arange(len(frame)), frame].float()  # (B, k, D, K)
        return Prediction(self.tokenizer.decode_logits(logits), logits.softmax(-1))


def mlp(inputs: int, width: int) -> nn.Sequential:
    """Build an MLP of three layers from `inputs` to `width` features, with layer normalisation and GELU."""
    first = [nn.Linear(inputs, width), nn.LayerNorm(width), nn.GELU()]
    second = [nn.Linear(width, width), nn.LayerNorm(width), nn.GELU()]
    return nn.Sequential(*first, *second, nn.Linear(width, width), nn.GELU())


def require_heads(width: int, heads: int) -> None:
    """Raise a UserError unless `width` is a multiple of `heads`."""
    if width % heads:
        raise UserError(f"model.width={width} must be a multiple of model.heads={heads}")


def newest(present: Tensor) -> Tensor:
    """Return the (B,) index of the last of the (B, T) frames that is present."""
    return (present * torch.arange(1, present.shape[1] + 1, device=present.device)).argmax(1)


def pixels(images: Tensor, size: int | None = None) -> Tensor:
    """Convert (B, T, H, W, 3) uint8 to (B·T, 3, H, W) float32 in 0 … 1, resized to a square of `size` [px] if given."""
    x = images.flatten(0, 1).permute(0, 3, 1, 2).float().div_(255)
    if size is not None and x.shape[-2:] != (size, size):
        x = F.interpolate(x, (size, size), mode="bilinear")
    return x
