"""RT-1: a transformer over a few tokens per frame, read out as action tokens (arXiv 2212.06817).

Shapes: B batch, T frames, N tokens per frame, A action slots per frame, k action chunk, D action components, K bins,
E width of a token.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.models.action_tokenizer import PerComponent
from vla.models.frames import FrameModel
from vla.models.image_tokenizer import ImageEncoder
from vla.models.model import Batch, TokenModel
from vla.models.text import TextEncoder
from vla.spec import Spec
from vla.types import Layers, Natural, NonNegative, Pixels, Rate, Shift, Steps, Width


class Layer(nn.Module):
    """One pre-norm transformer layer whose feed-forward part is a single linear map, as in RT-1.

    Args:
        width: E.
        heads: number of attention heads.
        key_width: width of a head; heads * key_width need not be E.
        dropout: of the attention weights and of the feed-forward output.
    """

    def __init__(self, width: int, heads: Layers, key_width: Width, dropout: Rate) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.attention_norm = nn.LayerNorm(width, eps=1e-6)
        self.query_key_value = nn.Linear(width, 3 * heads * key_width)
        self.output = nn.Linear(heads * key_width, width)
        self.linear_norm = nn.LayerNorm(width, eps=1e-6)
        self.linear = nn.Linear(width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """(B, L, E) to the same, where position i attends to j if the (L, L) bool mask[i, j] is true."""
        split = self.query_key_value(self.attention_norm(x)).unflatten(-1, (3, self.heads, -1))
        query, key, value = split.permute(2, 0, 3, 1, 4)  # (B, heads, L, key_width) each
        dropout = self.dropout if self.training else 0.0
        seen = F.scaled_dot_product_attention(query, key, value, mask, dropout)
        x = x + self.output(seen.transpose(1, 2).flatten(2))
        return x + F.dropout(self.linear(self.linear_norm(x)), self.dropout, self.training)


class RT1(FrameModel, TokenModel):
    """Image tokens of T frames through a causal transformer that never sees an action; every frame is read out.

    The sequence has, per frame, the tokens of every camera, the proprioception token if wanted, and A = k·D action
    slots that hold nothing but their position. What stands before an action slot predicts that slot's token.

    Args:
        image: makes the image encoder, called with `text_width`; the cameras share it.
        text: makes the text encoder, called with `width`.
        history: T.
        image_size: images are resized to this height and width [px]; null leaves them as they are.
        learned_tokens: tokens per camera and frame.
        keypoints: add, per camera, a token made of this many keypoints; the paper has none.
        proprioception: add a token for joints and gripper; the paper has none.
        chunk: k, the actions predicted for a frame.
        auxiliary: weight of the head that predicts the simulator's truth, in training only; 0 leaves it out.
        text_width: length of the sentence vector.
        width: E.
        layers, heads, key_width: of the transformer.
        dropout: of attention weights and feed-forward outputs.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height]; one
            offset for all frames of a window.
        spec: what a step looks like.
        tokenizer: what the logits mean.
    """

    mask: Tensor

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        history: Steps = 6,
        image_size: Pixels | None = 288,
        learned_tokens: Natural = 8,
        keypoints: Natural = 0,
        proprioception: bool = False,
        chunk: Steps = 1,
        auxiliary: NonNegative = 0.0,
        text_width: Width = 512,
        width: Width = 512,
        layers: Layers = 8,
        heads: Layers = 8,
        key_width: Width = 128,
        dropout: Rate = 0.1,
        shift: Shift = (20, 50),
        *,
        spec: Spec,
        tokenizer: PerComponent,
    ) -> None:
        super().__init__(
            image=image,
            text=text,
            history=history,
            image_size=image_size,
            learned_tokens=learned_tokens,
            keypoints=keypoints,
            proprioception=proprioception,
            chunk=chunk,
            auxiliary=auxiliary,
            text_width=text_width,
            width=width,
            shift=shift,
            spec=spec,
            tokenizer=tokenizer,
        )
        self.slots = chunk * len(spec.action)  # A
        length = history * (self.tokens + self.slots)
        self.positions = nn.Embedding(length, width)
        nn.init.normal_(self.positions.weight, std=0.05)  # where a token stands must not drown what it says
        self.layers = nn.ModuleList(Layer(width, heads, key_width, dropout) for _ in range(layers))
        self.head = nn.Linear(width, tokenizer.bins)
        self.register_buffer("mask", attention_mask(history, self.tokens, self.slots), persistent=False)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """logits: (B, T, k, D, K) for every frame; with an auxiliary head, truth: (B, T, S), standardised.

        There may be fewer frames than `history`. A batch with (B, T, N, E) "tokens" from `encode` needs no images.
        """
        tokens = batch["tokens"] if "tokens" in batch else self.encode(batch)
        empty = tokens.new_zeros(*tokens.shape[:2], self.slots, tokens.shape[-1])
        hidden = self.transform(torch.cat([tokens, empty], 2).flatten(1, 2))
        hidden = hidden.unflatten(1, (tokens.shape[1], -1))  # (B, T, N + A, E)
        before_slots = hidden[:, :, self.tokens - 1 : -1]  # (B, T, A, E)
        output = {"logits": self.head(before_slots).unflatten(2, self.logits_shape[:2])}
        if self.truth_head is not None:
            output["truth"] = self.truth_head(before_slots[:, :, 0])
        return output

    def transform(self, sequence: Tensor) -> Tensor:
        """(B, L, E) tokens, the first L of a whole window, to what the transformer makes of them, (B, L, E)."""
        length = sequence.shape[1]
        x = sequence + self.positions.weight[:length]
        for layer in self.layers:
            x = layer(x, self.mask[:length, :length])
        return x


def attention_mask(frames: int, tokens: int, slots: int) -> Tensor:
    """(L, L) bool, true where position i may attend to j: nothing later, and no action slot to an action slot.

    L is frames * (tokens + slots): image tokens first, then action slots, frame by frame.
    """
    is_slot = (torch.arange(tokens + slots) >= tokens).repeat(frames)
    between_slots = is_slot[:, None] & is_slot[None, :]
    return torch.ones(len(is_slot), len(is_slot), dtype=torch.bool).tril() & ~between_slots
