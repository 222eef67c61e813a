"""An autoregressive transformer decoder of action tokens, conditioned on images, robot state and instruction.

Shapes: B batch, T frames, M tokens of the context, k action chunk, L action tokens, K bins,
E width of a token.
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.types import Inherited, Layers, Rate, Width
from vla.models.context import EncodedContext
from vla.models.layers import Batch, mean_where, require_heads
from vla.models.model import ContextModel, Prediction
from vla.models.tokenizers.tokenizer import ComponentTokenizer


class _CachedLayer:
    """A layer of `nn.TransformerDecoder` with a key-value cache, for decoding token by token.

    Args:
        layer: pre-norm, batch first, outside training.
        context: of M tokens.
    """

    def __init__(self, layer: nn.TransformerDecoderLayer, context: EncodedContext) -> None:
        memory, padding = context.tokens, context.padding
        self._layer, self._present = layer, None if padding is None else ~padding[:, None, None]  # (B, 1, 1, M)
        self._memory_key, self._memory_value = _project(layer.multihead_attn, memory, 1, 3)
        self._key, self._value = _project(layer.self_attn, memory[:, :0], 1, 3)

    def __call__(self, x: Tensor) -> Tensor:
        """Process the next (B, 1, E) token; same shape."""
        layer = self._layer
        query, key, value = _project(layer.self_attn, layer.norm1(x), 0, 3)
        self._key, self._value = torch.cat([self._key, key], 2), torch.cat([self._value, value], 2)
        x = x + _attend(layer.self_attn, query, self._key, self._value)
        (query,) = _project(layer.multihead_attn, layer.norm2(x), 0, 1)
        x = x + _attend(layer.multihead_attn, query, self._memory_key, self._memory_value, self._present)
        hidden: Tensor = layer.linear1(layer.norm3(x))
        return x + layer.linear2(layer.activation(hidden))


def _project(attention: nn.MultiheadAttention, x: Tensor, start: int, stop: int) -> list[Tensor]:
    """Project (B, L, E) to queries 0, keys 1, values 2 from `start` up to `stop`, (B, heads, L, E / heads) each."""
    rows = slice(start * attention.embed_dim, stop * attention.embed_dim)
    projected = F.linear(x, attention.in_proj_weight[rows], attention.in_proj_bias[rows])
    return list(projected.unflatten(-1, (stop - start, attention.num_heads, -1)).permute(2, 0, 3, 1, 4))


def _attend(
    attention: nn.MultiheadAttention, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None
) -> Tensor:
    output = F.scaled_dot_product_attention(query, key, value, mask)
    return attention.out_proj(output.transpose(1, 2).flatten(2))


class Decoder(ContextModel):
    """`nn.TransformerDecoder` over action tokens, with causal self-attention and cross-attention to the context.

    The start token is the summary of the context. The decoder is trained on the newest frame of a window with teacher
    forcing, where some tokenizers draw the inputs near the labels (`sample_inputs`). Decoding is greedy: the most
    likely token is fed back each time, and the tokenizer turns the logits and tokens into actions.

    Args:
        layers, heads, feedforward: of the decoder; feedforward is the hidden width of its MLPs.
        dropout: of the decoder.
    """

    mask: Tensor

    def __init__(
        self, layers: Layers, heads: Layers, feedforward: Width, dropout: Rate, **inherited: Inherited
    ) -> None:
        super().__init__(**inherited)
        width, bins = self.width, self.tokenizer.bins
        require_heads(width, heads)
        self.length = self.tokenizer.length(self.chunk)  # L
        self.embedding = nn.Embedding(bins, width)
        self.positions = nn.Embedding(self.length, width)
        for embedding in (self.embedding, self.positions):
            nn.init.normal_(embedding.weight, std=0.05)
        layer = nn.TransformerDecoderLayer(width, heads, feedforward, dropout, batch_first=True, norm_first=True)
        self.decoder = nn.TransformerDecoder(layer, layers)
        for parameter in self.decoder.parameters():
            if parameter.dim() > 1:  # `nn.TransformerDecoder` starts with identical copies of one layer
                nn.init.xavier_uniform_(parameter)
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, bins)
        causal = torch.ones(self.length, self.length, dtype=torch.bool).triu(1)  # true: i must not attend to j
        self.register_buffer("mask", causal, persistent=False)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return logits: (B, L, K) and tokens: (B, L), the labels of the newest frame.

        With an auxiliary head also truth: (B, 1, S), normalised. With (B, T, N, E) "tokens", images are not needed.
        """
        tokens = self.tokenizer.tokenize(batch["action"][:, -1])
        inputs = self.tokenizer.sample_inputs(tokens, batch["action"][:, -1]) if self.training else tokens
        context = self.encode_context(batch)
        logits = self.head(self.decode(inputs[:, :-1], context))
        return {"logits": logits, "tokens": tokens, **self.predict_truth(context.summary.unsqueeze(1))}

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the tokenizer's loss over unmasked tokens and, outside training, their accuracy."""
        logits, tokens = output["logits"].float(), output["tokens"]
        mask = self.tokenizer.loss_mask(tokens, batch["perturbations"][:, -1])  # (B, L)
        losses = self.tokenizer.token_losses(logits, tokens, batch["action"][:, -1])
        result = {"action_loss": mean_where(losses, mask)}
        if not self.training:
            result["token_accuracy"] = mean_where((logits.argmax(-1) == tokens).float(), mask)
        return result

    def predict(self, batch: Batch) -> Prediction:
        """Decode the actions for the newest frame token by token."""
        logits, tokens = self.generate(self.encode_context(batch))
        actions = self.tokenizer.actions(logits, tokens)
        if not isinstance(self.tokenizer, ComponentTokenizer):
            return Prediction(actions)
        return Prediction(actions, logits.unflatten(1, (self.chunk, -1)).softmax(-1))

    def decode(self, tokens: Tensor, context: EncodedContext) -> Tensor:
        """Map the first n tokens, (B, n), to the hidden states that predict the first n + 1 tokens, (B, n + 1, E)."""
        inputs = torch.cat([context.summary.unsqueeze(1), self.embedding(tokens)], 1)
        length = inputs.shape[1]
        hidden = self.decoder(
            inputs + self.positions.weight[:length],
            context.tokens,
            tgt_mask=self.mask[:length, :length],
            memory_key_padding_mask=context.padding,
            tgt_is_causal=True,
        )
        return self.norm(hidden)

    def generate(self, context: EncodedContext) -> tuple[Tensor, Tensor]:
        """Decode greedily; returns (B, n, K) float32 logits and (B, n) tokens.

        n is L, or less if all sequences of the batch have ended.
        """
        layers = [_CachedLayer(cast("nn.TransformerDecoderLayer", layer), context) for layer in self.decoder.layers]
        token_vector = context.summary.unsqueeze(1)
        ended = torch.zeros(len(token_vector), 1, dtype=torch.bool, device=token_vector.device)
        logits, tokens = [], []
        for place in range(self.length):
            x = token_vector + self.positions.weight[place]
            for layer in layers:
                x = layer(x)
            logits.append(self.head(self.norm(x)).float())
            token = logits[-1].argmax(-1)
            tokens.append(token)
            token_vector = self.embedding(token)
            ended = ended | (token == self.tokenizer.end)
            if self.tokenizer.end >= 0 and ended.all():
                break
        return torch.cat(logits, 1), torch.cat(tokens, 1)
