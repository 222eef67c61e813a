"""π0.5: PaliGemma with an action expert whose norms depend on the time; the robot state is part of the sentence.

Shapes: see `vla.models.vlm.paligemma`.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import GemmaConfig
from transformers.models.gemma.modeling_gemma import GemmaAttention, GemmaMLP

from vla.io.types import Inherited
from vla.models.vlm.network import LayerCache, LayerOutput, Prefix, time_embedding
from vla.models.vlm.paligemma import PaliGemmaWithExpert


class PI05(PaliGemmaWithExpert):
    """The network of π0.5."""

    kind = "pi05"

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        config = self.expert.config
        width, numbers = config.hidden_size, range(config.num_hidden_layers)
        layers = [_AdaptiveLayer(config, number) for number in numbers]
        for layer in layers:
            layer.self_attn.apply(self.expert._init_weights)
            layer.mlp.apply(self.expert._init_weights)
        self.expert.layers = nn.ModuleList(layers)
        self.expert.norm = _AdaptiveNorm(width, config.rms_norm_eps)
        self.time_mlp_in, self.time_mlp_out = nn.Linear(width, width), nn.Linear(width, width)

    def velocity(self, prefix: Prefix, noisy: Tensor, time: Tensor) -> Tensor:
        """Predict the velocity of (B, k, A) noisy actions at times (B,) or (B, k)."""
        hidden = self.action_in_proj(noisy)
        times = time if time.dim() == 2 else time.unsqueeze(1)  # (B, k or 1)
        clock = time_embedding(times, hidden.shape[-1], torch.float64).to(hidden.dtype)
        condition = F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(clock))))
        present = prefix.present.new_ones(noisy.shape[:2])
        hidden, _ = self.attend(self.expert, hidden, present, prefix, condition=condition)
        return self.action_out_proj(self.expert.norm(hidden, condition)[0].float())


class _AdaptiveNorm(nn.Module):
    """RMS norm with scale and shift from a condition, which also gives a gate for the output of the next sublayer.

    All three are zero at first, so that a new layer changes nothing.

    Args:
        width: E, of tokens and condition.
        epsilon: added to the mean square.
    """

    def __init__(self, width: int, epsilon: float) -> None:
        super().__init__()
        self.epsilon = epsilon
        self.dense = nn.Linear(width, 3 * width)
        self._init_weights(self.dense)

    def _init_weights(self, module: nn.Linear) -> None:
        """Initialise with zeros; this hook of transformers' models takes precedence over that of the whole expert."""
        nn.init.zeros_(module.weight)
        nn.init.zeros_(module.bias)

    def forward(self, tokens: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Return (B, N, E) normalised tokens and their gate, given a (B, N or 1, E) condition."""
        scale, shift, gate = self.dense(condition).chunk(3, -1)
        normal = tokens * torch.rsqrt(tokens.float().square().mean(-1, keepdim=True) + self.epsilon)
        return (normal * (1 + scale.float()) + shift.float()).to(tokens.dtype), gate.to(tokens.dtype)


class _AdaptiveLayer(nn.Module):
    """A layer of Gemma with adaptive norms."""

    def __init__(self, config: GemmaConfig, number: int) -> None:
        super().__init__()
        self.self_attn, self.mlp = GemmaAttention(config, number), GemmaMLP(config)
        self.input_layernorm = _AdaptiveNorm(config.hidden_size, config.rms_norm_eps)
        self.post_attention_layernorm = _AdaptiveNorm(config.hidden_size, config.rms_norm_eps)

    def forward(
        self, hidden: Tensor, condition: Tensor, past: tuple[Tensor, Tensor] | None, **attention: Any
    ) -> LayerOutput:
        """Process (B, N, E) tokens, given the condition of the norms, and keys and values of preceding tokens."""
        cache = LayerCache(past)
        normal, gate = self.input_layernorm(hidden, condition)
        hidden = hidden + self.self_attn(normal, past_key_values=cache, **attention)[0] * gate
        normal, gate = self.post_attention_layernorm(hidden, condition)
        return hidden + self.mlp(normal) * gate, cache.keys, cache.values
