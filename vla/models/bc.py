"""Behaviour cloning with an MLP over image keypoints and proprioception, the smallest model.

Shapes: B batch, k action chunk, D action components, K bins, S truth scalars.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from vla.io.types import Inherited, Width
from vla.models.context import KeypointFeatures
from vla.models.layers import Batch, mlp
from vla.models.model import TokenModel
from vla.models.vision.image_tokenizer import ImageEncoder


class BC(TokenModel):
    """Behaviour cloning from one frame: image keypoints, robot state and instruction through an MLP.

    Args:
        image: factory of the image encoder, called with `text_width` once per camera.
        keypoints: keypoints per camera.
        proprioception: use the robot state.
    """

    def __init__(
        self, image: Callable[..., ImageEncoder], keypoints: Width, proprioception: bool, **inherited: Inherited
    ) -> None:
        super().__init__(**inherited)
        self.require_vector()
        make_encoder = partial(image, text_width=self.text.width)
        self.features = KeypointFeatures(keypoints, proprioception, make_encoder, self.spec)
        self.mlp = mlp(sum([*self.features.image_widths, *self.features.state_widths, self.text.width]), self.width)
        self.head = nn.Linear(self.width, self.chunk * len(self.spec.action) * self.tokenizer.bins)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return logits: (B, 1, k, D, K) for the newest frame; with an auxiliary head, truth: (B, 1, S), normalised."""
        text = self.text(batch["text"])  # (B, text_width)
        images, state = self.features(batch, text)
        hidden = self.mlp(torch.cat([*state, text, *images], -1)).unsqueeze(1)  # (B, 1, width)
        return {"logits": self.head(hidden).unflatten(-1, self.logits_shape), **self.predict_truth(hidden)}
