"""Behaviour cloning with an MLP over image keypoints and proprioception, the smallest model.

Shapes: B batch, k action chunk, D action components, K bins, S truth scalars.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vla.io.types import Inherited
from vla.models.model import Batch, TokenModel, mlp
from vla.models.one_frame import OneFrameModel


class BC(OneFrameModel, TokenModel):
    """Behaviour cloning from one frame: image keypoints, robot state and instruction through an MLP."""

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.mlp = mlp(sum([*self.image_widths, *self.state_widths, self.text.width]), self.width)
        self.head = nn.Linear(self.width, self.chunk * len(self.spec.action) * self.tokenizer.bins)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return logits: (B, 1, k, D, K) for the newest frame; with an auxiliary head, truth: (B, 1, S), normalised."""
        text = self.text(batch["text"])  # (B, text_width)
        features = [*self.state_features(batch), text, *self.image_features(batch, text)]
        hidden = self.mlp(torch.cat(features, -1)).unsqueeze(1)  # (B, 1, width)
        return {"logits": self.head(hidden).unflatten(-1, self.logits_shape), **self.predict_truth(hidden)}
