"""An autoregressive transformer decoder of action tokens, conditioned on images, robot state and instruction.

Shapes: B batch, T frames, N tokens per frame, M = T·N + 2 tokens of memory, k action chunk, L action tokens, K bins,
E width of a token.
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.types import Inherited, Layers, Rate, Width
from vla.models.frame_tokens import FrameModel
from vla.models.model import Batch, Prediction, mean_where, newest, require_heads
from vla.models.tokenizers.tokenizer import PerComponent


class CachedLayer:
    """A layer of `nn.TransformerDecoder` with a key-value cache, for decoding token by token.

    Args:
        layer: pre-norm, batch first, outside training.
        memory: (B, M, E).
        padding: (B, M) bool, true for masked positions of the memory.
    """

    def __init__(self, layer: nn.TransformerDecoderLayer, memory: Tensor, padding: Tensor) -> None:
        self._layer, self._present = layer, ~padding[:, None, None]  # (B, 1, 1, M)
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


def _project(attention: nn.MultiheadAttention, x: Tensor, first: int, last: int) -> list[Tensor]:
    """Project (B, L, E) to queries 0, keys 1, values 2 from `first` up to `last`, (B, heads, L, E / heads) each."""
    rows = slice(first * attention.embed_dim, last * attention.embed_dim)
    projected = F.linear(x, attention.in_proj_weight[rows], attention.in_proj_bias[rows])
    return list(projected.unflatten(-1, (last - first, attention.num_heads, -1)).permute(2, 0, 3, 1, 4))


def _attend(
    attention: nn.MultiheadAttention, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None
) -> Tensor:
    attended = F.scaled_dot_product_attention(query, key, value, mask)
    return attention.out_proj(attended.transpose(1, 2).flatten(2))


def newest_last(frames: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Roll (B, T, N, E) frames and their (B, T) mask until the newest present frame is last: 1, 2, - → -, 1, 2."""
    length = present.shape[1]
    places = (torch.arange(length, device=present.device) + newest(present)[:, None] + 1) % length  # (B, T)
    return frames.gather(1, places[:, :, None, None].expand_as(frames)), present.gather(1, places)


class Decoder(FrameModel):
    """`nn.TransformerDecoder` over action tokens, with causal self-attention and cross-attention to the frames.

    The start token is an MLP of the newest frame and the instruction. Without it, with attention alone, training takes
    several times as long.

    Training is on the newest frame of a window, with teacher forcing, or with inputs drawn near the labels if the
    tokenizer has some (`sampled`). Decoding is greedy: each most likely token is fed
    back, and the tokenizer turns the logits into an action.

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
        self.instruction_token = nn.Linear(self.text.width, width)
        self.memory_norm = nn.LayerNorm(width)
        self.fuse = nn.Sequential(
            nn.Linear((self.tokens + 1) * width, 2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, 2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, width),
        )
        self.embedding = nn.Embedding(bins, width)
        self.memory_positions = nn.Embedding(self.history * self.tokens, width)
        self.positions = nn.Embedding(self.length, width)
        for embedding in (self.embedding, self.memory_positions, self.positions):
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

        With an auxiliary head also truth: (B, 1, S), normalised. A batch with (B, T, N, E) "tokens" from `encode` needs
        no images.
        """
        tokens = self.tokenizer.tokenize(batch["action"][:, -1])
        inputs = self.tokenizer.sampled(tokens, batch["action"][:, -1]) if self.training else tokens
        memory, padding = self.memory(batch)
        logits = self.head(self.decode(inputs[:, :-1], memory, padding))
        return {"logits": logits, "tokens": tokens, **self.predict_truth(memory[:, -1:])}

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the tokenizer's loss over unmasked tokens and, outside training, their accuracy."""
        logits, tokens = output["logits"].float(), output["tokens"]
        mask = self.tokenizer.loss_mask(tokens, batch["valid"][:, -1], batch["unperturbed"][:, -1])  # (B, L)
        losses = self.tokenizer.token_losses(logits, tokens, batch["action"][:, -1])
        result = {"action_loss": mean_where(losses, mask)}
        if not self.training:
            result["token_accuracy"] = mean_where((logits.argmax(-1) == tokens).float(), mask)
        return result

    def predict(self, batch: Batch) -> Prediction:
        """Decode the actions for the newest frame token by token."""
        logits, tokens = self.generate(*self.memory(batch))
        actions = self.tokenizer.actions(logits, tokens)
        if not isinstance(self.tokenizer, PerComponent):
            return Prediction(actions)
        return Prediction(actions, logits.unflatten(1, (self.chunk, -1)).softmax(-1))

    def memory(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the memory of cross-attention, (B, M, E), and its (B, M) bool padding mask, true for padding.

        The last token is the fused one. There may be fewer frames than `history`: positions are aligned at the newest
        frame.
        """
        frames = batch["tokens"] if "tokens" in batch else self.encode(batch)
        frames, present = newest_last(frames, batch["present"])
        visual = frames.flatten(1, 2)  # (B, T·N, E)
        visual = visual + self.memory_positions.weight[-visual.shape[1] :]
        instruction = self.instruction_token(self.text(batch["text"])).unsqueeze(1)
        fused = self.fuse(torch.cat([frames[:, -1], instruction], 1).flatten(1)).unsqueeze(1)
        padding = ~present.repeat_interleave(self.tokens, 1)
        return self.memory_norm(torch.cat([visual, instruction, fused], 1)), F.pad(padding, (0, 2))

    def decode(self, tokens: Tensor, memory: Tensor, padding: Tensor) -> Tensor:
        """Map the first n tokens, (B, n), to the hidden states that predict the first n + 1 tokens, (B, n + 1, E)."""
        inputs = torch.cat([memory[:, -1:], self.embedding(tokens)], 1)
        length = inputs.shape[1]
        hidden = self.decoder(
            inputs + self.positions.weight[:length],
            memory,
            tgt_mask=self.mask[:length, :length],
            memory_key_padding_mask=padding,
            tgt_is_causal=True,
        )
        return self.norm(hidden)

    def generate(self, memory: Tensor, padding: Tensor) -> tuple[Tensor, Tensor]:
        """Decode greedily; returns (B, n, K) float32 logits and (B, n) tokens.

        n is L, or less if all sequences of the batch have ended.
        """
        layers = [
            CachedLayer(cast("nn.TransformerDecoderLayer", layer), memory, padding) for layer in self.decoder.layers
        ]
        token_vector = memory[:, -1:]
        ended = torch.zeros(len(memory), 1, dtype=torch.bool, device=memory.device)
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
