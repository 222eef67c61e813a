"""The smallest model: keypoints of every image and proprioception through an MLP.

Shapes: B batch, T history frames, k action chunk, D action components, K bins.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from vla.models.action_tokenizer import PerComponent
from vla.models.image_tokenizer import ImageEncoder, Keypoints, RandomShift
from vla.models.model import Batch, Standardize, TokenModel, perceptron, pixels
from vla.models.text import TextEncoder
from vla.spec import Spec
from vla.types import NonNegative, Shift, Steps, Width


class BC(TokenModel):
    """Behaviour cloning from one frame: where things are in every image, how the arm stands, and what was said.

    Args:
        image: makes the image encoder of one camera, called with `text_width`; every camera gets its own.
        text: makes the text encoder, called with `width`.
        chunk: k, the actions predicted at once.
        keypoints: keypoints per camera.
        text_width: length of the sentence vector.
        width: hidden width of the MLP.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height].
        auxiliary: weight of the head that predicts the simulator's truth, in training only; 0 leaves it out.
        spec: what a step looks like.
        tokenizer: what the logits mean.
    """

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        chunk: Steps = 1,
        keypoints: Width = 32,
        text_width: Width = 64,
        width: Width = 512,
        shift: Shift = (12, 12),
        auxiliary: NonNegative = 1.0,
        *,
        spec: Spec,
        tokenizer: PerComponent,
    ) -> None:
        super().__init__(
            history=1,
            chunk=chunk,
            text=text(width=text_width),
            auxiliary=auxiliary,
            truth_width=width,
            spec=spec,
            tokenizer=tokenizer,
        )
        self.shift = RandomShift(*shift)
        encoders = [image(text_width=text_width) for _ in spec.cameras]
        self.images = nn.ModuleList(encoders)
        readers = [Keypoints(encoder.channels, keypoints) for encoder in encoders]
        self.keypoints = nn.ModuleList(readers)
        self.proprioception = Standardize(self.posture_width)
        seen = sum(keypoints * reader.width for reader in readers)
        features = seen + self.posture_width + text_width
        self.trunk = perceptron(features, width)
        self.head = nn.Linear(width, chunk * len(spec.action) * tokenizer.bins)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """logits: (B, 1, k, D, K) for the newest frame; with an auxiliary head, truth: (B, 1, S), standardised."""
        text = self.text(batch["text"])  # (B, text_width)
        features = [self.proprioception(self.posture(batch)[:, -1:], batch["present"][:, -1:]).flatten(1), text]
        for camera, encoder, keypoints in zip(self.spec.cameras, self.images, self.keypoints, strict=True):
            features.append(keypoints(encoder(pixels(self.shift(batch["rgb"][camera][:, -1:])), text)).flatten(1))
        hidden = self.trunk(torch.cat(features, -1)).unsqueeze(1)  # (B, 1, width)
        output = {"logits": self.head(hidden).unflatten(-1, self.logits_shape)}
        if self.truth_head is not None:
            output["truth"] = self.truth_head(hidden)
        return output
