"""RT-1: a transformer over a few tokens per frame that predicts action tokens (arXiv 2212.06817).

Shapes: B batch, T frames, N tokens per frame, A action slots per frame, k action chunk, D action components, K bins,
E width of a token.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.types import Inherited, Layers, Positive, Rate, Width
from vla.models.context import TokenContext
from vla.models.layers import Batch
from vla.models.model import ContextModel, TokenModel


class _Layer(nn.Module):
    """One pre-norm transformer layer whose feed-forward part is a single linear map, as in RT-1.

    Args:
        width: E.
        heads: number of attention heads.
        key_width: width of a head; heads * key_width need not be E.
        dropout: of the attention weights and of the feed-forward output.
    """

    def __init__(self, width: int, heads: int, key_width: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.attention_norm = nn.LayerNorm(width, eps=1e-6)
        self.query_key_value = nn.Linear(width, 3 * heads * key_width)
        self.output = nn.Linear(heads * key_width, width)
        self.linear_norm = nn.LayerNorm(width, eps=1e-6)
        self.linear = nn.Linear(width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Map (B, L, E) to the same shape; position i attends to j if the (L, L) bool mask[i, j] is true."""
        projections = self.query_key_value(self.attention_norm(x)).unflatten(-1, (3, self.heads, -1))
        query, key, value = projections.permute(2, 0, 3, 1, 4)  # (B, heads, L, key_width) each
        dropout = self.dropout if self.training else 0.0
        attention = F.scaled_dot_product_attention(query, key, value, mask, dropout)
        x = x + self.output(attention.transpose(1, 2).flatten(2))
        return x + F.dropout(self.linear(self.linear_norm(x)), self.dropout, self.training)


class RT1(ContextModel, TokenModel):
    """A causal transformer over the image tokens of T frames, without action inputs, that predicts for every frame.

    Per frame, the sequence has the tokens of every camera, the optional proprioception token, and A = k·D action slots
    that contain only their position embedding. The position before an action slot predicts its token.

    The paper has no keypoints and no proprioception token.

    Args:
        context: factory of the context, of which only the tokens of the frames are used.
        layers, heads, key_width: of the transformer.
        dropout: of attention weights and feed-forward outputs.
        position_std: standard deviation of the initial position embeddings. If it is small compared with the
            tokens, all slots first attend to the mean of all tokens, and learn slowly to differ.
    """

    context: TokenContext
    mask: Tensor

    def __init__(
        self,
        context: Callable[..., TokenContext],
        layers: Layers,
        heads: Layers,
        key_width: Width,
        dropout: Rate,
        position_std: Positive,
        **inherited: Inherited,
    ) -> None:
        super().__init__(context=partial(context, frames_alone=True), **inherited)
        width, tokens = self.width, self.context.per_frame
        self.slots = self.chunk * len(self.spec.action)  # A
        self.positions = nn.Embedding(self.history * (tokens + self.slots), width)
        nn.init.normal_(self.positions.weight, std=position_std)
        self.layers = nn.ModuleList(_Layer(width, heads, key_width, dropout) for _ in range(layers))
        self.head = nn.Linear(width, self.tokenizer.bins)
        self.register_buffer("mask", attention_mask(self.history, tokens, self.slots), persistent=False)

    def encode(self, batch: Batch) -> Tensor:
        """Return (B, T, N, E) tokens of the frames."""
        return self.context.encode(batch, self.text(batch["text"]))

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return logits: (B, T, k, D, K) for every frame; with an auxiliary head, truth: (B, T, S), normalised.

        There may be fewer frames than `history`. A batch with (B, T, N, E) "tokens" from `encode` needs no images.
        """
        frames = batch["tokens"] if "tokens" in batch else self.encode(batch)
        tokens, inverse_order = roll_oldest_first(frames, batch["present"])
        empty_slots = tokens.new_zeros(*tokens.shape[:2], self.slots, tokens.shape[-1])
        hidden = self.transform(torch.cat([tokens, empty_slots], 2).flatten(1, 2))
        hidden = hidden.unflatten(1, (tokens.shape[1], -1))  # (B, T, N + A, E)
        slot_states = hidden[:, :, self.context.per_frame - 1 : -1]  # (B, T, A, E)
        slot_states = slot_states.gather(1, inverse_order[:, :, None, None].expand_as(slot_states))
        logits = self.head(slot_states).unflatten(2, self.logits_shape[:2])
        return {"logits": logits, **self.predict_truth(slot_states[:, :, 0])}

    def transform(self, sequence: Tensor) -> Tensor:
        """Apply the transformer to (B, L, E) tokens, the first L of a window; same shape."""
        length = sequence.shape[1]
        x = sequence + self.positions.weight[:length]
        for layer in self.layers:
            x = layer(x, self.mask[:length, :length])
        return x


def roll_oldest_first(frames: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Roll (B, T, N, E) frames until the oldest present one is first, -, 1, 2 → 1, 2, -; also return (B, T) places that
    undo it. A policy's first frames have these positions too, in which none attends to absent frames."""
    steps, offset = torch.arange(present.shape[1], device=present.device), present.int().argmax(1, keepdim=True)
    order, inverse_order = ((steps + shift) % present.shape[1] for shift in (offset, -offset))
    return frames.gather(1, order[:, :, None, None].expand_as(frames)), inverse_order


def attention_mask(frames: int, tokens: int, slots: int) -> Tensor:
    """Build the (L, L) causal mask, true where position i may attend to j; action slots do not attend to action slots.

    L is frames * (tokens + slots): image tokens first, then action slots, frame by frame.
    """
    is_slot = (torch.arange(tokens + slots) >= tokens).repeat(frames)
    between_slots = is_slot[:, None] & is_slot[None, :]
    return torch.ones(len(is_slot), len(is_slot), dtype=torch.bool).tril() & ~between_slots
