"""A transformer decoder that writes a chunk of actions token by token, looking at images, posture and sentence.

Shapes: B batch, T frames, N tokens per frame, M = T·N + 2 tokens of memory, k action chunk, L action tokens, K bins,
E width of a token.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.models.action_tokenizer import ActionTokenizer, PerComponent
from vla.models.frames import FrameModel
from vla.models.image_tokenizer import ImageEncoder
from vla.models.model import Batch, Prediction, newest, require_heads
from vla.models.text import TextEncoder
from vla.spec import Spec
from vla.types import Layers, Natural, NonNegative, Pixels, Rate, Shift, Steps, Width


class CachedLayer:
    """A layer of `nn.TransformerDecoder` that is given one token after the other.

    Keys and values of the memory are computed once, those of the tokens so far are kept.

    Args:
        layer: pre-norm, batch first, outside training.
        memory: (B, M, E).
        absent: (B, M) bool, true for what must not be looked at.
    """

    def __init__(self, layer: nn.TransformerDecoderLayer, memory: Tensor, absent: Tensor) -> None:
        self._layer, self._present = layer, ~absent[:, None, None]  # (B, 1, 1, M)
        self._memory_key, self._memory_value = _project(layer.multihead_attn, memory, 1, 3)
        self._key, self._value = _project(layer.self_attn, memory[:, :0], 1, 3)

    def __call__(self, x: Tensor) -> Tensor:
        """The next (B, 1, E) token to the same shape."""
        layer = self._layer
        query, key, value = _project(layer.self_attn, layer.norm1(x), 0, 3)
        self._key, self._value = torch.cat([self._key, key], 2), torch.cat([self._value, value], 2)
        x = x + _attend(layer.self_attn, query, self._key, self._value)
        (query,) = _project(layer.multihead_attn, layer.norm2(x), 0, 1)
        x = x + _attend(layer.multihead_attn, query, self._memory_key, self._memory_value, self._present)
        hidden: Tensor = layer.linear1(layer.norm3(x))
        return x + layer.linear2(layer.activation(hidden))


def _project(attention: nn.MultiheadAttention, x: Tensor, first: int, last: int) -> list[Tensor]:
    """Of (B, L, E), queries 0, keys 1 and values 2 from `first` up to `last`, each (B, heads, L, E / heads)."""
    rows = slice(first * attention.embed_dim, last * attention.embed_dim)
    projected = F.linear(x, attention.in_proj_weight[rows], attention.in_proj_bias[rows])
    return list(projected.unflatten(-1, (last - first, attention.num_heads, -1)).permute(2, 0, 3, 1, 4))


def _attend(
    attention: nn.MultiheadAttention, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None
) -> Tensor:
    seen = F.scaled_dot_product_attention(query, key, value, mask)
    mixed: Tensor = attention.out_proj(seen.transpose(1, 2).flatten(2))
    return mixed


def newest_last(frames: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """(B, T, N, E) frames and (B, T) bool, turned until the newest one that is present is the last: of 1, 2, -, - it
    makes -, -, 1, 2."""
    length = present.shape[1]
    places = (torch.arange(length, device=present.device) + newest(present)[:, None] + 1) % length  # (B, T)
    return frames.gather(1, places[:, :, None, None].expand_as(frames)), present.gather(1, places)


class Decoder(FrameModel):
    """`nn.TransformerDecoder` over action tokens, each of which sees those before it and all that was perceived.

    Before the first token stands one in which all of the newest frame and the sentence have met in an MLP: attention
    alone, which starts out looking everywhere, takes several times as long to find what counts.

    It learns from the newest frame of a window, with the right tokens before the one that it has to guess. When it
    acts, the most likely token is what the next one follows, while the action is read by the tokenizer.

    Args:
        image: makes the image encoder, called with `text_width`; the cameras share it.
        text: makes the text encoder, called with `width`.
        history: T.
        image_size: images are resized to this height and width [px]; null leaves them as they are.
        learned_tokens: tokens per camera and frame.
        keypoints: add, per camera, a token made of this many keypoints.
        proprioception: add a token for joints and gripper.
        chunk: k, the actions predicted at once.
        auxiliary: weight of the head that predicts the simulator's truth, in training only; 0 leaves it out.
        text_width: length of the sentence vector.
        width: E.
        layers, heads, feedforward: of the decoder; feedforward is the hidden width of its MLPs.
        dropout: of the decoder.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height]; one
            offset for all frames of a window.
        spec: what a step looks like.
        tokenizer: what the tokens mean, and how many there are.
    """

    mask: Tensor

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        history: Steps = 2,
        image_size: Pixels | None = None,
        learned_tokens: Natural = 4,
        keypoints: Natural = 32,
        proprioception: bool = True,
        chunk: Steps = 1,
        auxiliary: NonNegative = 1.0,
        text_width: Width = 64,
        width: Width = 128,
        layers: Layers = 2,
        heads: Layers = 4,
        feedforward: Width = 256,
        dropout: Rate = 0.0,
        shift: Shift = (12, 12),
        *,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        require_heads(width, heads)
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
        self.length = tokenizer.length(chunk)  # L
        self.sentence_token = nn.Linear(text_width, width)
        self.memory_norm = nn.LayerNorm(width)
        self.meet = nn.Sequential(
            nn.Linear((self.tokens + 1) * width, 2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, 2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, width),
        )
        self.embedding = nn.Embedding(tokenizer.bins, width)
        self.memory_positions = nn.Embedding(history * self.tokens, width)
        self.positions = nn.Embedding(self.length, width)
        for embedding in (self.embedding, self.memory_positions, self.positions):
            nn.init.normal_(embedding.weight, std=0.05)
        layer = nn.TransformerDecoderLayer(width, heads, feedforward, dropout, batch_first=True, norm_first=True)
        self.decoder = nn.TransformerDecoder(layer, layers)
        for parameter in self.decoder.parameters():
            if parameter.dim() > 1:  # its layers are copies of one, and would all start alike
                nn.init.xavier_uniform_(parameter)
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, tokenizer.bins)
        causal = torch.ones(self.length, self.length, dtype=torch.bool).triu(1)  # true where i must not attend to j
        self.register_buffer("mask", causal, persistent=False)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """logits: (B, L, K) of the (B, L) tokens of the newest frame's labels, which are there too; with an auxiliary
        head, truth: (B, 1, S), standardised. A batch with (B, T, N, E) "tokens" from `encode` needs no images.
        """
        tokens = self.tokenizer.tokenize(batch["action"][:, -1])
        before = self.tokenizer.drawn(tokens, batch["action"][:, -1]) if self.training else tokens
        memory, absent = self.memory(batch)
        output = {"logits": self.head(self.decode(before[:, :-1], memory, absent)), "tokens": tokens}
        if self.truth_head is not None:
            output["truth"] = self.truth_head(memory[:, -1:])
        return output

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """The tokenizer's loss over the tokens that count and, outside training, the share of them that are right."""
        logits, tokens = output["logits"].float(), output["tokens"]
        counted = self.tokenizer.learned(tokens, batch["valid"][:, -1])  # (B, L)
        losses = self.tokenizer.token_losses(logits, tokens, batch["action"][:, -1])
        found = {"action_loss": (losses * counted).sum() / counted.sum().clamp(min=1)}
        if not self.training:
            found["token_accuracy"] = (logits.argmax(-1) == tokens)[counted].float().mean()
        return found

    def predict(self, batch: Batch) -> Prediction:
        """The actions after the newest frame, written token by token."""
        logits, tokens = self.generate(*self.memory(batch))
        actions = self.tokenizer.actions(logits, tokens)
        if not isinstance(self.tokenizer, PerComponent):
            return Prediction(actions)
        return Prediction(actions, logits.unflatten(1, (self.chunk, -1)).softmax(-1))

    def memory(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """What the decoder looks at, (B, M, E), and (B, M) bool, true where there is nothing.

        The last token is the one in which all have met. There may be fewer frames than `history`: where a token stands
        counts from the newest.
        """
        frames = batch["tokens"] if "tokens" in batch else self.encode(batch)
        frames, present = newest_last(frames, batch["present"])
        seen = frames.flatten(1, 2)  # (B, T·N, E)
        seen = seen + self.memory_positions.weight[-seen.shape[1] :]
        sentence = self.sentence_token(self.text(batch["text"])).unsqueeze(1)
        met = self.meet(torch.cat([frames[:, -1], sentence], 1).flatten(1)).unsqueeze(1)
        absent = ~present.repeat_interleave(self.tokens, 1)
        return self.memory_norm(torch.cat([seen, sentence, met], 1)), F.pad(absent, (0, 2))

    def decode(self, tokens: Tensor, memory: Tensor, absent: Tensor) -> Tensor:
        """(B, n) tokens, the first n of a sequence, to what precedes each of the first n + 1: (B, n + 1, E)."""
        started = torch.cat([memory[:, -1:], self.embedding(tokens)], 1)
        length = started.shape[1]
        hidden = self.decoder(
            started + self.positions.weight[:length],
            memory,
            tgt_mask=self.mask[:length, :length],
            memory_key_padding_mask=absent,
            tgt_is_causal=True,
        )
        normal: Tensor = self.norm(hidden)
        return normal

    def generate(self, memory: Tensor, absent: Tensor) -> tuple[Tensor, Tensor]:
        """(B, n, K) float32 logits and the (B, n) most likely tokens, each chosen after the one before.

        They are L, or fewer if all sequences of the batch have ended.
        """
        layers = [CachedLayer(layer, memory, absent) for layer in self.decoder.layers]
        following = memory[:, -1:]
        ended = torch.zeros(len(memory), 1, dtype=torch.bool, device=memory.device)
        logits, tokens = [], []
        for place in range(self.length):
            x = following + self.positions.weight[place]
            for layer in layers:
                x = layer(x)
            logits.append(self.head(self.norm(x)).float())
            token = logits[-1].argmax(-1)
            tokens.append(token)
            following = self.embedding(token)
            ended = ended | (token == self.tokenizer.end)
            if self.tokenizer.end >= 0 and ended.all():
                break
        return torch.cat(logits, 1), torch.cat(tokens, 1)
