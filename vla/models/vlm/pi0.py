"""π0: PaliGemma with an action expert, and a token of the robot state between images and sentence and the actions.

Shapes: see `vla.models.vlm.paligemma`; also S padded state.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vla.io.types import Inherited, Width
from vla.models.vlm.network import Prefix, with_time
from vla.models.vlm.paligemma import PaliGemmaWithExpert


class PI0(PaliGemmaWithExpert):
    """The network of π0. Every action is joined with the time before it enters the expert.

    Args:
        state_width: S.
    """

    kind = "pi0"

    def __init__(self, state_width: Width, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.state_width = state_width
        width = self.action_in_proj.out_features
        self.state_proj = nn.Linear(state_width, width)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)

    def prefix(self, images: Tensor, cameras: Tensor, tokens: Tensor, sentence: Tensor, state: Tensor | None) -> Prefix:
        """Encode images and sentence, then the state in the expert, where it attends to them but not to actions."""
        assert state is not None
        trunk_prefix = super().prefix(images, cameras, tokens, sentence, None)
        token = self.state_proj(state).unsqueeze(1)
        return self.attend(self.expert, token, sentence.new_ones(len(token), 1), trunk_prefix)[1]

    def velocity(self, prefix: Prefix, noisy: Tensor, time: Tensor) -> Tensor:
        """Predict the velocity of (B, k, A) noisy actions at times (B,) or (B, k)."""
        hidden = self.action_in_proj(noisy)
        # In this precision, which transformers uses, the angles of the highest frequency are off by 1e-4.
        hidden = with_time(hidden, time.float(), (self.action_time_mlp_in, self.action_time_mlp_out), torch.float32)
        hidden, _ = self.attend(self.expert, hidden, prefix.present.new_ones(noisy.shape[:2]), prefix)
        return self.action_out_proj(self.expert.norm(hidden).float())
