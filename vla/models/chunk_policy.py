"""Base class of models that predict a chunk of continuous actions: context encoding and action scaling.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token, S truth scalars.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vla.io.types import Inherited
from vla.models.model import Batch, mlp
from vla.models.one_frame import OneFrameModel


class ChunkModel(OneFrameModel):
    """A model that predicts k continuous actions from one frame.

    Actions are scaled to -1 … 1 between the bounds of the tokenizer, and are not tokenized.

    Context tokens: one fused token, then one per camera, one for the robot state if it is used, one for the
    instruction. The auxiliary head uses the features of the fused token.
    """

    TRUTH_INPUT = 2
    uses_tokens = False

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        hidden = self.TRUTH_INPUT * self.width
        widths = [*self.image_widths, *self.state_widths, self.text.width]
        self.tokens = nn.ModuleList(nn.Linear(features, self.width) for features in widths)
        self.fuse = mlp(sum(widths), hidden)
        self.fused_token = nn.Linear(hidden, self.width)

    def encode_context(self, batch: Batch, robot_state: list[Tensor]) -> dict[str, Tensor]:
        """Return context: (B, M, E) of the newest frame; with an auxiliary head, truth: (B, 1, S), normalised.

        `robot_state` is the result of `state_features`.
        """
        text = self.text(batch["text"])  # (B, text_width)
        features = [*self.image_features(batch, text), *robot_state, text]
        hidden = self.fuse(torch.cat(features, -1))  # (B, 2 E)
        others = [linear(feature) for linear, feature in zip(self.tokens, features, strict=True)]
        context = torch.stack([self.fused_token(hidden), *others], 1)
        return {"context": context, **self.predict_truth(hidden.unsqueeze(1))}


def transformer_decoder(width: int, layers: int, heads: int) -> nn.Module:
    """Build a pre-norm transformer decoder without dropout."""
    layer = nn.TransformerDecoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
    return nn.TransformerDecoder(layer, layers, nn.LayerNorm(width))
