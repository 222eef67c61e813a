"""A context around a network of transformers, tiny and knowing nothing."""

from __future__ import annotations

from typing import Any

import torch
from fake_batch import make_act
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaModel

from vla.models.act import ACT
from vla.models.context import Context, EncodedContext, Proprioception

SIZES = {"hidden_size": 32, "intermediate_size": 64, "num_attention_heads": 2, "num_hidden_layers": 3, "vocab_size": 4}


class TrunkContext(Context):
    """The robot state, the mean colour of every camera and the instruction through a Llama."""

    def __init__(self, **inherited: Any) -> None:
        super().__init__(**inherited)
        self.length = 2 + len(self.spec.cameras)
        self.proprioception = Proprioception(self.spec)
        self.state_token = nn.Linear(self.proprioception.width, self.width)
        self.image_token, self.text_token = nn.Linear(3, self.width), nn.Linear(self.text_width, self.width)
        self.trunk = LlamaModel(LlamaConfig(**SIZES))

    def forward(self, batch: dict[str, Any], text: Tensor) -> EncodedContext:
        images = [self.image_token(images[:, -1].float().mean((1, 2)) / 255) for images in batch["rgb"].values()]
        tokens = [*images, self.state_token(self.proprioception(batch)[:, -1]), self.text_token(text)]
        hidden = self.trunk(inputs_embeds=torch.stack(tokens, 1)).last_hidden_state
        return EncodedContext(hidden, hidden[:, -1])


def make_trunk_model(**options: Any) -> ACT:
    """A model that processes can share: it draws no numbers, and every window has one action to learn from."""
    torch.manual_seed(0)
    return make_act(context=TrunkContext, chunk=1, execute=1, kl_weight=0.0, **options)
