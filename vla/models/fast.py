"""FAST: a chunk of actions as a short sequence of tokens, made of its frequencies (arXiv 2501.09747).

Shapes: k actions of a chunk, D action components, L tokens of a sequence, K tokens there are, … any leading dimensions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer
from tokenizers.models import BPE
from tokenizers.trainers import BpeTrainer
from torch import Tensor

from vla.models.action_tokenizer import LEAST_SPAN, ActionTokenizer, Statistics, data_bounds
from vla.spec import Spec
from vla.types import Bins, Positive, Steps

FIRST = 0x100  # code point of the smallest coefficient; up to 0xD800 every code point is a character
END = "<end>"
QUANTILES = (0.01, 0.99)  # of the data are scaled to -1 and 1


class Fast(ActionTokenizer):
    """Every component's cosine transform over the chunk, rounded, low frequencies first, as byte pairs of the data.

    What moves smoothly has few coefficients that are not 0, and byte-pair encoding makes one token of what often stands
    together, so sequences are of any length up to k·D coefficients, and an end token. A sequence that a model made up
    may stand for too few coefficients, of which the rest are 0, or for too many, of which the rest is left out.

    A chunk counts in the loss as a whole, if its first action does.

    Args:
        bins: K; the end token, one for every coefficient, and the rest for those that often stand together.
        scale: steps of a coefficient in the unit of the scaled actions; more are finer, and need more tokens.
        chunk: k.
        spec: gives the range of allowed actions.
        statistics: the data; None before a checkpoint's tokens are loaded.
    """

    end = 0
    centre: Tensor  # (D,) of the scaled range, in the units of the action
    spread: Tensor  # (D,) half of the scaled range, in the units of the action
    basis: Tensor  # (k, k) orthonormal cosine transform of type II: frequency, time

    def __init__(
        self,
        bins: Bins = 1024,
        scale: Positive = 10.0,
        chunk: Steps = 8,
        *,
        spec: Spec,
        statistics: Statistics | None = None,
    ) -> None:
        if scale <= 0:
            raise ValueError(f"tokenizer.scale={scale} must be above 0")
        low, high = data_bounds(spec, statistics)
        super().__init__(spec, low, high, bins)
        self.scale, self.chunk = scale, chunk
        sample = np.stack([low, high])[:, None].repeat(chunk, 1) if statistics is None else statistics.chunks(chunk)
        first, last = np.quantile(sample.astype(np.float64), QUANTILES, axis=(0, 1))
        allowed = np.array(spec.high) - np.array(spec.low)
        self.register_buffer("centre", torch.as_tensor((first + last) / 2, dtype=torch.float32))
        self.register_buffer(
            "spread", torch.as_tensor(np.maximum(last - first, LEAST_SPAN * allowed) / 2, dtype=torch.float32)
        )
        self.register_buffer("basis", cosines(chunk), persistent=False)
        self._least, self._most = 0, 0  # coefficients
        self._bpe, self._pieces = Tokenizer(BPE()), [""]
        if statistics is not None:
            self._fit(torch.from_numpy(np.ascontiguousarray(sample, np.float32)))

    def length(self, chunk: int) -> int:
        """One token per coefficient and one for the end.

        Raises:
            ValueError: chunks of another length were fitted.
        """
        if chunk != self.chunk:
            raise ValueError(
                f"the model predicts {chunk} actions, its tokenizer reads {self.chunk}: set tokenizer.chunk={chunk}"
            )
        return chunk * self.components + 1

    @torch.compiler.disable
    def tokenize(self, actions: Tensor) -> Tensor:
        """(…, k, D) float chunks, clipped to the bounds, as (…, L) int64 tokens, filled up with the end token."""
        texts = self._texts(self._round(actions).clamp(self._least, self._most))  # only what has a character
        written = [encoding.ids for encoding in self._bpe.encode_batch(texts, add_special_tokens=False)]
        length = 1 + max(len(ids) for ids in written)
        rows = [ids + [self.end] * (length - len(ids)) for ids in written]
        return torch.tensor(rows, device=actions.device).view(*actions.shape[:-2], length)

    @torch.compiler.disable
    def detokenize(self, tokens: Tensor) -> Tensor:
        """(…, L) tokens, up to the first end token if there is one, as (…, k, D) float actions."""
        count = self.chunk * self.components
        rows = []
        for ids in tokens.reshape(-1, tokens.shape[-1]).tolist():
            ids = ids[: ids.index(self.end)] if self.end in ids else ids
            text = "".join(self._pieces[token] for token in ids if token < len(self._pieces))[:count]
            values = [ord(character) - FIRST + self._least for character in text]
            rows.append(values + [0] * (count - len(values)))
        coefficients = torch.tensor(rows, dtype=torch.float32, device=tokens.device)
        scaled = _exact(self.basis.T, coefficients.view(-1, self.chunk, self.components)) / self.scale
        return (scaled * self.spread + self.centre).view(*tokens.shape[:-1], self.chunk, self.components)

    def learned(self, tokens: Tensor, valid: Tensor) -> Tensor:
        """(…, L) bool: of the chunks whose first action counts, the tokens up to the first end token."""
        ended = (tokens == self.end).cumsum(-1)
        return ((ended == 0) | ((ended == 1) & (tokens == self.end))) & valid[..., :1]

    def used(self, tokens: Tensor) -> str:
        """How many tokens appear."""
        return f"{len(tokens.unique())} of {self.bins} tokens used"

    def get_extra_state(self) -> dict[str, Any]:
        """What was fitted and is no tensor, for the checkpoint."""
        return {"coefficients": [self._least, self._most], "bpe": self._bpe.to_str()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what was fitted."""
        self._least, self._most = state["coefficients"]
        self._learn(Tokenizer.from_str(state["bpe"]))

    def _fit(self, chunks: Tensor) -> None:
        coefficients = self._round(chunks)
        self._least, self._most = int(coefficients.min()), int(coefficients.max())
        alphabet = [chr(FIRST + number) for number in range(self._most - self._least + 1)]
        if len(alphabet) >= self.bins:
            raise ValueError(
                f"the coefficients take {len(alphabet)} values, more than tokenizer.bins={self.bins} can tell apart: "
                f"raise it, or lower tokenizer.scale={self.scale}"
            )
        bpe = Tokenizer(BPE())
        trainer = BpeTrainer(vocab_size=self.bins, special_tokens=[END], initial_alphabet=alphabet, show_progress=False)
        bpe.train_from_iterator(self._texts(coefficients), trainer)
        self._learn(bpe)

    def _learn(self, bpe: Tokenizer) -> None:
        self._bpe = bpe
        vocabulary = sorted(bpe.get_vocab().items(), key=lambda item: item[1])
        self._pieces = ["" if number == self.end else piece for piece, number in vocabulary]

    def _round(self, actions: Tensor) -> Tensor:
        """(…, k, D) actions as (…, k, D) whole coefficients, frequency by frequency."""
        inside = torch.minimum(torch.maximum(actions, self.low), self.high)
        return (_exact(self.basis, (inside - self.centre) / self.spread) * self.scale).round()

    def _texts(self, coefficients: Tensor) -> list[str]:
        """(…, k, D) coefficients as one text of k·D characters for each chunk."""
        codes = (coefficients - self._least + FIRST).long().reshape(-1, self.chunk * self.components)
        return ["".join(map(chr, row)) for row in codes.tolist()]


def _exact(matrix: Tensor, values: Tensor) -> Tensor:
    with torch.autocast(values.device.type, enabled=False):  # other coefficients would come out in half precision
        return matrix @ values


def cosines(count: int) -> Tensor:
    """(count, count) the orthonormal cosine transform of type II: rows are frequencies, columns moments."""
    place = torch.arange(count, dtype=torch.float64)
    waves = torch.cos(torch.pi / count * (place + 0.5) * place[:, None]) * (2 / count) ** 0.5
    waves[0] /= 2**0.5
    return waves.float()
