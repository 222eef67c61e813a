"""What every model is: from a batch of windows to actions, most of them by way of logits over action tokens.

Shapes: B batch, T history frames, k action chunk, D action components, K bins, S truth scalars, P proprioception.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.models.action_tokenizer import ActionTokenizer, PerComponent
from vla.models.kinematics import ForwardKinematics
from vla.models.sharding import summed
from vla.models.text import TextEncoder
from vla.spec import Spec

Batch = dict[str, Any]


class Standardize(nn.Module):
    """Zero mean and unit variance by statistics that are gathered in training and kept in the checkpoint.

    Unlike batch normalisation it never uses the statistics of the current batch alone, whose noise would blur what
    a joint angle means. Processes that train together gather what all of them see.

    Args:
        width: number of components.
    """

    count: Tensor
    mean: Tensor
    square: Tensor

    LEAST_DEVIATION = 1e-3  # a component that never moved in the data must not explode when it does
    LARGEST = 5.0  # standard deviations; what lies further out was never seen

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("square", torch.zeros(width))  # mean squared distance from the mean

    @property
    def deviation(self) -> Tensor:
        """(width,) standard deviations."""
        return self.square.sqrt().clamp(min=self.LEAST_DEVIATION)

    def forward(self, values: Tensor, present: Tensor) -> Tensor:
        """(B, T, width) values, of which the (B, T) bool `present` are real, to the same shape; the rest become 0."""
        if self.training:
            self._gather(values.detach(), present.unsqueeze(-1).to(values.dtype))
        standard = ((values - self.mean) / self.deviation).clamp(-self.LARGEST, self.LARGEST)
        return standard * present.unsqueeze(-1)

    def inverse(self, standard: Tensor) -> Tensor:
        """(…, width) standardised values in their own units again."""
        return standard * self.deviation + self.mean

    def _gather(self, values: Tensor, weight: Tensor) -> None:
        added = summed(weight.sum())
        total = (self.count + added).clamp(min=1)
        mean = summed((values * weight).sum((0, 1))) / added.clamp(min=1)
        square = summed(((values - mean).square() * weight).sum((0, 1)))
        # Two groups merged into one (Chan et al. 1979).
        shift = mean - self.mean
        between = shift.square() * self.count * added / total
        self.square.copy_((self.square * self.count + square + between) / total)
        self.mean.add_(shift * added / total)
        self.count.add_(added)


class Prediction(NamedTuple):
    """What a model would do after the newest frame of each window."""

    actions: Tensor  # (B, k, D) float32, in the units of the spec, not yet clipped to its bounds
    probabilities: Tensor | None = None  # (B, k, D, K) float32 of the tokens, if they are one per component


class Model(nn.Module, ABC):
    """A policy's network: a batch of windows → actions; it knows no simulator.

    A batch is a dict:
        rgb: camera → (B, T, H, W, 3) uint8; proprio: (B, T, P) float32; present: (B, T) bool, false for padding;
        text: from `model.text.tokenize`; and to learn from, action: (B, T, k, D) float32,
        valid: (B, T, k) bool, true for the first so many of a frame, truth: (B, T, S) float32. A model that draws its
        actions draws them with noise: (B, k, D) float32, standard normal, where it is given.

    Of the k actions a policy executes `execute`, all unless a model says otherwise, before it looks again.

    Args:
        history: T, the frames the model looks at.
        chunk: k, the actions it predicts for a frame.
        text: the encoder of the instruction.
        auxiliary: weight of the loss of the head that predicts the truth; 0 leaves the head out.
        truth_width: length of the features which that head reads.
        spec: what a step looks like.
        tokenizer: how actions and tokens belong together, and between which bounds actions lie.
    """

    def __init__(
        self,
        history: int,
        chunk: int,
        text: TextEncoder,
        auxiliary: float,
        truth_width: int,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        super().__init__()
        self.history, self.chunk, self.auxiliary = history, chunk, auxiliary
        self.execute = chunk
        self.spec, self.tokenizer, self.text = spec, tokenizer, text
        self.kinematics = ForwardKinematics(spec.chain) if spec.chain else None
        self.posture_width = len(spec.joints) + 1 + (ForwardKinematics.WIDTH if spec.chain else 0)
        self.truth_head: nn.Linear | None = None
        if auxiliary > 0 and spec.truth_size > 0:
            self.truth_head = nn.Linear(truth_width, spec.truth_size)
            self.truth_scale = Standardize(spec.truth_size)

    def posture(self, batch: Batch) -> Tensor:
        """(B, T, posture_width) joint positions, gripper opening and, where the chain is known, pose of the tool.

        Without velocities: a learner that sees them learns that an arm at rest stays at rest.
        """
        count = len(self.spec.joints)
        joints, rest = batch["proprio"][..., :count], batch["proprio"][..., 2 * count :]
        return torch.cat([joints, rest] if self.kinematics is None else [joints, rest, self.kinematics(joints)], -1)

    def encode(self, batch: Batch) -> Tensor | None:
        """What of each frame can be kept while a window moves on, (B, T, N, E); None for a model that keeps nothing.

        `forward` then takes it as "tokens" in place of images.
        """
        return None

    def draw(self, random: torch.Generator) -> Tensor | None:
        """The "noise" to act with once, (1, k, D); None of a model that draws nothing."""
        return None

    @abstractmethod
    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """What `action_loss` reads, for the last T' of the T frames; with an auxiliary head also truth: (B, T', S),
        standardised. This is the part that compiles."""

    @abstractmethod
    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """The scalar `action_loss` of what `forward` made of a batch, and whatever else is worth logging."""

    @abstractmethod
    def predict(self, batch: Batch) -> Prediction:
        """What to do after the newest frame, the last one that is present: what follows it must not matter.

        Needs "present", "text", and the images and joints or the "tokens" of all frames.
        """

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The scalar `loss` to minimise, and its parts by name."""
        output = self(batch)
        losses = self.action_loss(output, batch)
        losses["loss"] = losses["action_loss"]
        if self.truth_head is not None:
            frames = output["truth"].shape[1]
            present = batch["present"][:, -frames:]
            target = self.truth_scale(batch["truth"][:, -frames:], present)
            error = (output["truth"].float() - target).square().mean(-1)  # (B, T')
            losses["truth_loss"] = (error * present).sum() / present.sum().clamp(min=1)
            losses["loss"] = losses["loss"] + self.auxiliary * losses["truth_loss"]
        return losses


class TokenModel(Model):
    """A model that scores, in one pass, every bin of every component of an action.

    Its `forward` gives logits: (B, T', k, D, K).
    """

    tokenizer: PerComponent

    @property
    def logits_shape(self) -> tuple[int, int, int]:
        """k, D and K."""
        return self.chunk, len(self.spec.action), self.tokenizer.bins

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """The tokenizer's loss over all frames and, outside training, the share of tokens that are right."""
        logits = output["logits"]
        frames = logits.shape[1]
        action, valid = batch["action"][:, -frames:], batch["valid"][:, -frames:]
        losses = {"action_loss": self.tokenizer.loss(logits, action, valid)}
        if not self.training:
            right = logits.argmax(-1) == self.tokenizer.encode(action)  # (B, T', k, D)
            losses["token_accuracy"] = right[valid].float().mean()
        return losses

    def predict(self, batch: Batch) -> Prediction:
        """The actions that the tokenizer reads from the logits of the newest frame."""
        place = newest(batch["present"])
        logits = self(batch)["logits"][torch.arange(len(place)), place].float()  # (B, k, D, K)
        return Prediction(self.tokenizer.read(logits), logits.softmax(-1))


def perceptron(inputs: int, width: int) -> nn.Sequential:
    """What many features of any size meet in: three layers from `inputs` to `width`, normalised on the way."""
    first = [nn.Linear(inputs, width), nn.LayerNorm(width), nn.GELU()]
    second = [nn.Linear(width, width), nn.LayerNorm(width), nn.GELU()]
    return nn.Sequential(*first, *second, nn.Linear(width, width), nn.GELU())


def require_heads(width: int, heads: int) -> None:
    """Raise a ValueError unless attention can share `width` out among so many heads."""
    if width % heads:
        raise ValueError(f"model.width={width} must be a multiple of model.heads={heads}")


def newest(present: Tensor) -> Tensor:
    """(B,) place of the last of the (B, T) frames that is present."""
    return (present * torch.arange(1, present.shape[1] + 1, device=present.device)).argmax(1)


def pixels(images: Tensor, size: int | None = None) -> Tensor:
    """(B, T, H, W, 3) uint8 as (B·T, 3, H, W) float32 in 0 … 1, resized to a square of `size` [px] if given."""
    x = images.flatten(0, 1).permute(0, 3, 1, 2).float().div_(255)
    if size is not None and x.shape[-2:] != (size, size):
        x = F.interpolate(x, (size, size), mode="bilinear")
    return x
