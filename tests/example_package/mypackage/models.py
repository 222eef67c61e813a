"""Two models. Shapes: B batch, k action chunk, D action components, K bins, S truth scalars."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vla.io.types import Inherited
from vla.models.layers import Batch, mean_where, mlp, pixels
from vla.models.model import Model, Prediction, TokenModel


class Mine(TokenModel):
    """All pixels, the pose and the instruction through an MLP."""

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        height, breadth = self.image_size
        inputs = 3 * height * breadth * len(self.spec.cameras)
        self.mlp = mlp(inputs + self.robot_state.width + self.text.width, self.width)
        self.head = nn.Linear(self.width, self.chunk * len(self.spec.action) * self.tokenizer.bins)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """logits: (B, 1, k, D, K), and truth: (B, 1, S) with an auxiliary head."""
        images = [pixels(batch["rgb"][camera][:, -1:]).flatten(1) for camera in self.spec.cameras]
        features = torch.cat([*images, self.robot_state(batch)[:, -1], self.text(batch["text"])], -1)
        hidden = self.mlp(features).unsqueeze(1)
        return {"logits": self.head(hidden).unflatten(-1, self.logits_shape), **self.predict_truth(hidden)}


class Regression(Model):
    """The pose and the instruction through an MLP to actions, by the mean squared error."""

    uses_tokens = False

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.mlp = mlp(self.robot_state.width + self.text.width, self.width)
        self.head = nn.Linear(self.width, self.chunk * len(self.spec.action))

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """actions: (B, k, D), scaled; and truth: (B, 1, S) with an auxiliary head."""
        hidden = self.mlp(torch.cat([self.robot_state(batch)[:, -1], self.text(batch["text"])], -1))
        actions = self.head(hidden).unflatten(-1, (self.chunk, -1))
        return {"actions": actions, **self.predict_truth(hidden.unsqueeze(1))}

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """The error of the scaled actions, over those that count."""
        error = (output["actions"] - self.scaled(batch["action"][:, -1])).square().mean(-1)  # (B, k)
        return {"action_loss": mean_where(error, batch["valid"][:, -1])}

    def predict(self, batch: Batch) -> Prediction:
        """Actions in the units of the spec."""
        return Prediction(self.unscaled(self(batch)["actions"]))
