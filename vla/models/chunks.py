"""What the models share that predict a chunk of continuous actions: how they see, and how they scale actions.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token, S truth scalars.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from vla.models.action_tokenizer import ActionTokenizer
from vla.models.image_tokenizer import ImageEncoder, Keypoints, RandomShift
from vla.models.model import Batch, Model, Standardize, perceptron, pixels
from vla.models.text import TextEncoder
from vla.spec import Spec
from vla.types import NonNegative, Shift, Steps, Width

HIDDEN = 2  # width of the layers in which all features meet, in widths of a token


class ChunkModel(Model):
    """A model that looks at one frame and predicts k actions as numbers, of which a policy executes the first few.

    Actions are scaled to -1 … 1 between the bounds of the tokenizer, and nothing of them becomes a token.

    The context has a token for the keypoints of each camera, for proprioception and for the sentence, and before them
    one in which all of these have met; that one, the truth is read from.

    Args:
        image: makes the image encoder of one camera, called with `text_width`; every camera gets its own.
        text: makes the text encoder, called with `width`.
        chunk: k.
        execute: how many of the k actions a policy executes before it looks again.
        keypoints: keypoints per camera.
        text_width: length of the sentence vector.
        width: E.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height].
        auxiliary: weight of the head that predicts the simulator's truth, in training only; 0 leaves it out.
        spec: what a step looks like.
        tokenizer: between which bounds actions lie.

    Raises:
        ValueError: `execute` is more than `chunk`.
    """

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        chunk: Steps,
        execute: Steps,
        keypoints: Width,
        text_width: int,
        width: int,
        shift: Shift,
        auxiliary: NonNegative,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        hidden = HIDDEN * width
        super().__init__(
            history=1,
            chunk=chunk,
            text=text(width=text_width),
            auxiliary=auxiliary,
            truth_width=hidden,
            spec=spec,
            tokenizer=tokenizer,
        )
        if execute > chunk:
            raise ValueError(f"model.execute={execute} is more than the model.chunk={chunk} actions that are predicted")
        self.execute = execute
        self.shift = RandomShift(*shift)
        encoders = [image(text_width=text_width) for _ in spec.cameras]
        self.images = nn.ModuleList(encoders)
        readers = [Keypoints(encoder.channels, keypoints) for encoder in encoders]
        self.keypoints = nn.ModuleList(readers)
        self.proprioception = Standardize(self.posture_width)
        widths = [*[keypoints * reader.width for reader in readers], self.posture_width, text_width]
        self.tokens = nn.ModuleList(nn.Linear(features, width) for features in widths)
        self.meet = perceptron(sum(widths), hidden)
        self.first_token = nn.Linear(hidden, width)

    def standing(self, batch: Batch) -> Tensor:
        """(B, posture_width) standardised joints and gripper opening of the newest frame."""
        return self.proprioception(self.posture(batch)[:, -1:], batch["present"][:, -1:]).squeeze(1)

    def see(self, batch: Batch, standing: Tensor) -> dict[str, Tensor]:
        """context: (B, M, E) of the newest frame; with an auxiliary head, truth: (B, 1, S), standardised."""
        text = self.text(batch["text"])  # (B, text_width)
        seen = []
        for camera, encoder, keypoints in zip(self.spec.cameras, self.images, self.keypoints, strict=True):
            seen.append(keypoints(encoder(pixels(self.shift(batch["rgb"][camera][:, -1:])), text)).flatten(1))
        features = [*seen, standing, text]
        hidden = self.meet(torch.cat(features, -1))  # (B, HIDDEN · E)
        others = [linear(feature) for linear, feature in zip(self.tokens, features, strict=True)]
        output = {"context": torch.stack([self.first_token(hidden), *others], 1)}
        if self.truth_head is not None:
            output["truth"] = self.truth_head(hidden).unsqueeze(1)
        return output

    def scaled(self, action: Tensor) -> Tensor:
        """(…, D) actions as numbers in -1 … 1, and further out beyond the bounds of the tokenizer."""
        low, high = self.tokenizer.low, self.tokenizer.high
        return 2 * (action - low) / (high - low) - 1

    def unscaled(self, scaled: Tensor) -> Tensor:
        """The (…, D) float32 actions that `scaled` makes these numbers of."""
        low, high = self.tokenizer.low, self.tokenizer.high
        return (scaled.float() + 1) / 2 * (high - low) + low


def mean_where(values: Tensor, valid: Tensor) -> Tensor:
    """The mean over (…, k, D) values where the (…, k) bool `valid` is true."""
    return (values.mean(-1) * valid).sum() / valid.sum().clamp(min=1)
