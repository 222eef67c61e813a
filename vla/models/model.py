"""Base classes of models, which map a batch of windows to actions.

Shapes: B batch, T history frames, k action chunk, D action components, K bins, S truth scalars, P state components.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import ImageSize, Inherited, NonNegative, Shift, Steps, Width
from vla.models.chunking import Chunking, RunningPlans, Velocity
from vla.models.context import Context, EncodedContext
from vla.models.kinematics import RobotState
from vla.models.layers import Batch, RunningNormalizer, mean_where, newest_index
from vla.models.text.ngrams import TextEncoder
from vla.models.tokenizers.tokenizer import ActionTokenizer, ComponentTokenizer
from vla.models.transforms import Fit, Transforms
from vla.models.trunk import is_factor, is_within
from vla.models.vision.image_tokenizer import ImageEncoder, RandomShift
from vla.spec import Spec


class Prediction(NamedTuple):
    """Predicted actions after the newest frame of each window."""

    actions: Tensor  # (B, k, D) float32, in the units of the spec, not clipped to its bounds
    probabilities: Tensor | None = None  # (B, k, D, K) float32, for tokenizers with one token per component


class Model(nn.Module, ABC):
    """A policy network: batch of windows → actions.

    A batch is a dict that `transforms` has made of observations:
        rgb: camera → (B, T, H, W, 3) uint8 of `image_size`; state: (B, T, P) float32; present: (B, T) bool, false for
        padding; text: from `text.tokenize`. For training also action: (B, T, k, D) float32; valid: (B, T, k) bool, the
        loss mask, true for a prefix of each chunk; executed: the executed actions, in the shape of action;
        perturbations: (B, T, k) int, perturbed steps before each label, -1 beyond the episode; truth: (B, T, S)
        float32. For generative models optionally noise: (B, k, D) float32, standard normal; for plans that continue
        running ones also running: (B, k, D) float32, and remaining and delay: (B,), see `chunking.RunningPlans`.

    A policy executes the first `execute` of the k actions before it predicts again.

    Args:
        text: factory of the text encoder, called with `width`.
        text_width: length of the instruction vector.
        chunk: k, number of actions predicted for a frame.
        width: hidden width; in a transformer that of a token.
        auxiliary: loss weight of the head that predicts the simulator state, used in training only; 0 omits it.
        execute: number of the k actions that a policy executes before it predicts again; None: all.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height]; one
            offset for all frames of a window.
        image_size: height and width of the images that the model sees [px]; None: those of the demonstrations.
        fit: for an `image_size` of another aspect ratio: crop the centre, pad with black borders, or stretch.
        spec: observation and action spaces.
        tokenizer: converts between actions and tokens, and gives the action bounds.

    Raises:
        UserError: `execute` exceeds `chunk`.
    """

    history = 1  # T, number of frames in the input
    continues = False  # whether its plans can continue running ones, by a `chunking` that the policy sets
    chunking: Chunking | None = None
    prefix = 0  # largest number of actions that training gives at the start of a chunk
    uses_tokens = True  # whether actions are predicted as tokens; else as numbers, scaled by the tokenizer's bounds

    def __init__(
        self,
        text: Callable[..., TextEncoder],
        text_width: Width,
        chunk: Steps,
        width: Width,
        auxiliary: NonNegative,
        execute: Steps | None = None,
        shift: Shift = (0, 0),
        image_size: ImageSize | None = None,
        fit: Fit = "crop",
        *,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        super().__init__()
        self.chunk, self.execute = chunk, chunk if execute is None else execute
        if self.execute > chunk:
            raise UserError(f"model.execute={execute} is more than model.chunk={chunk}, the actions that are predicted")
        self.width, self.spec, self.tokenizer = width, spec, tokenizer
        self.text = text(width=text_width)
        self.image_size = image_size or spec.image_size
        demonstrations, size = ((shape[0], shape[1]) for shape in (spec.image_size, self.image_size))
        self.transforms = Transforms(demonstrations, size, fit, self.text.tokenize)
        self.shift = RandomShift(*shift)
        self.robot_state = RobotState(spec)
        self.add_truth_head(width, auxiliary)

    def require_vector(self) -> None:
        """Raise a UserError unless the text encoder maps a sentence to a vector."""
        if not self.text.vectors:
            raise UserError(
                f"{type(self).__name__} needs a vector of the sentence, and {type(self.text).__name__} makes tokens: "
                "choose another text encoder, such as model/text=ngrams"
            )

    def add_truth_head(self, width: int, auxiliary: float) -> None:
        """Add the head that predicts the simulator state from features of a width, unless its loss weight is 0."""
        self.auxiliary = auxiliary
        self.truth_head: nn.Linear | None = None
        if auxiliary > 0 and self.spec.truth_size > 0:
            self.truth_head = nn.Linear(width, self.spec.truth_size)
            self.truth_scale = RunningNormalizer(self.spec.truth_size)

    def fit(self, states: np.ndarray, actions: np.ndarray) -> None:
        """Fit the model's own normalisation, if any, to (N, P) states and (N, D) actions of all steps."""

    def augment(self, batch: Batch) -> Batch:
        """Return a training batch with randomly shifted images; this part is not compiled."""
        return {**batch, "rgb": self.shift(batch["rgb"])}

    def encode(self, batch: Batch) -> Tensor | None:
        """Return tokens of each frame, (B, T, N, E), to cache and pass to `forward` as "tokens" instead of images.

        None for a model without such a cache.
        """
        return None

    def sample_noise(self, random: torch.Generator) -> Tensor | None:
        """Sample the "noise" of one prediction, (1, k, …), standard normal; None for a deterministic model."""
        noise = getattr(self, "noise", None)
        return torch.randn(1, *noise.shape, generator=random) if isinstance(noise, Tensor) else None

    def predict_truth(self, features: Tensor) -> dict[str, Tensor]:
        """Return truth: (B, T', S), normalised, given (B, T', width) features; nothing without an auxiliary head."""
        return {} if self.truth_head is None else {"truth": self.truth_head(features)}

    def continuing_velocity(self, velocity: Velocity, batch: Batch) -> Velocity:
        """Return a velocity that continues the running plans of a batch, if it has any."""
        if self.chunking is None or "running" not in batch:
            return velocity
        running = RunningPlans(self.scaled(batch["running"]), batch["remaining"], batch["delay"])
        return self.chunking.continuing_velocity(velocity, running)

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
        """Return the inputs of `action_loss` for the last T' of the T frames, and the result of `predict_truth`.

        This part is compiled.
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
            mask = batch["present"][:, -frames:] & truth.isfinite().all(-1)
            target = self.truth_scale(truth.nan_to_num(0.0, 0.0, 0.0), mask)
            error = (output["truth"].float() - target).square().mean(-1)  # (B, T')
            losses["truth_loss"] = mean_where(error, mask)
            losses["loss"] = losses["loss"] + self.auxiliary * losses["truth_loss"]
        return losses

    def parameter_groups(
        self, learning_rate: float, weight_decay: float, rates: Mapping[str, float], frozen: Collection[str]
    ) -> list[dict[str, Any]]:
        """Return groups of trained parameters for AdamW; weight decay applies to matrices and filters, not embeddings.

        Networks of timm say in `no_weight_decay` which parameters are embeddings, such as those of positions.

        Args:
            learning_rate: of parts that `rates` does not name.
            weight_decay: of matrices and filters.
            rates: part, such as "context" or "context.image", → factor of its learning rate; the longest name counts.
            frozen: parts that are not trained, except for LoRA factors in them.

        Raises:
            UserError: a name matches no part, or nothing is left to train.
        """
        parameters = dict(self.named_parameters())
        _require_parts(parameters, "rates", rates)
        _require_parts(parameters, "frozen", frozen)
        for name, parameter in parameters.items():
            if is_within(name, frozen) and not is_factor(name):
                parameter.requires_grad_(False)
        trained_parameters = {name: parameter for name, parameter in parameters.items() if parameter.requires_grad}
        if not trained_parameters:
            raise UserError("learner.frozen leaves nothing to train: name fewer parts")
        embedding_ids, groups = _embedding_ids(self), dict[tuple[float, bool], list[Tensor]]()
        for name, parameter in trained_parameters.items():
            longest_part = max((part for part in rates if is_within(name, [part])), key=len, default=None)
            factor = 1.0 if longest_part is None else rates[longest_part]
            decays = parameter.dim() > 1 and id(parameter) not in embedding_ids
            groups.setdefault((factor, decays), []).append(parameter)
        return [
            {"params": group, "lr": learning_rate * factor, "weight_decay": weight_decay if decays else 0.0}
            for (factor, decays), group in sorted(groups.items(), key=lambda item: item[0], reverse=True)
        ]


def _require_parts(parameters: Collection[str], key: str, parts: Collection[str]) -> None:
    for part in parts:
        if not any(is_within(name, [part]) for name in parameters):
            parent = part.rpartition(".")[0]  # the longest beginning of the name that is a part; "": the model
            while parent and not any(is_within(name, [parent]) for name in parameters):
                parent = parent.rpartition(".")[0]
            names = [name.removeprefix(f"{parent}.") for name in parameters if not parent or is_within(name, [parent])]
            parts = ", ".join(dict.fromkeys(name.partition(".")[0] for name in names))
            raise UserError(f"learner.{key} names {part}, which is no part of the model: {parent or 'it'} has {parts}")


def _embedding_ids(model: nn.Module) -> set[int]:
    """Return the ids of the parameters that are embeddings."""
    ids = {id(module.weight) for module in model.modules() if isinstance(module, nn.Embedding)}
    for module in model.modules():
        if callable(exclusions := getattr(module, "no_weight_decay", None)):
            parameters = dict(module.named_parameters())
            ids |= {id(parameters[name]) for name in exclusions() if name in parameters}
    return ids


class ContextModel(Model):
    """A model that predicts actions from a `Context`.

    Args:
        context: factory of the context, called with the arguments of `Context`.
        image: factory of the image encoders of the context.
    """

    def __init__(
        self, context: Callable[..., Context], image: Callable[..., ImageEncoder], **inherited: Inherited
    ) -> None:
        super().__init__(**inherited)
        self.require_vector()
        self.context = context(image=image, text_width=self.text.width, width=self.width, spec=self.spec)
        self.history = self.context.history

    def encode(self, batch: Batch) -> Tensor | None:
        """Return tokens of each frame, as `Context.encode`."""
        return self.context.encode(batch, self.text(batch["text"]))

    def encode_context(self, batch: Batch) -> EncodedContext:
        """Return the context of a batch, in which "tokens" may take the place of images and states."""
        return self.context(batch, self.text(batch["text"]))


class TokenModel(Model):
    """A model that predicts logits of every bin of every action component in one pass.

    Its `forward` returns logits: (B, T', k, D, K).
    """

    tokenizer: ComponentTokenizer

    def __init__(self, *, tokenizer: ComponentTokenizer, **inherited: Inherited) -> None:
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
        frame, logits = newest_index(batch["present"]), self(batch)["logits"]
        if logits.shape[1] != batch["present"].shape[1]:
            raise UserError(f"{type(self).__name__}.forward must return logits for every frame of its history")
        logits = logits[torch.arange(len(frame), device=frame.device), frame].float()  # (B, k, D, K)
        return Prediction(self.tokenizer.decode_logits(logits), logits.softmax(-1))
