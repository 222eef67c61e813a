"""A model. Shapes: B batch, k action chunk, D action components, K bins, S truth scalars."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vla.io.types import Inherited
from vla.models.model import Batch, TokenModel, mlp, pixels


class Mine(TokenModel):
    """All pixels, the pose and the instruction through an MLP."""

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        height, breadth = self.spec.image_size
        inputs = 3 * height * breadth * len(self.spec.cameras)
        self.mlp = mlp(inputs + self.robot_state_width + self.text.width, self.width)
        self.head = nn.Linear(self.width, self.chunk * len(self.spec.action) * self.tokenizer.bins)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """logits: (B, 1, k, D, K), and truth: (B, 1, S) with an auxiliary head."""
        images = [pixels(batch["rgb"][camera][:, -1:]).flatten(1) for camera in self.spec.cameras]
        features = torch.cat([*images, self.robot_state(batch)[:, -1], self.text(batch["text"])], -1)
        hidden = self.mlp(features).unsqueeze(1)
        return {"logits": self.head(hidden).unflatten(-1, self.logits_shape), **self.predict_truth(hidden)}
