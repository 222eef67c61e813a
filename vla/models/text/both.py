"""N-grams and a sentence encoder together.

Shapes: B sentences, L n-grams of the longest, E width of the frozen encoder.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from vla.io.errors import UserError
from vla.models.text.huggingface import HuggingFace
from vla.models.text.ngrams import NGrams, TextEncoder


class Both(TextEncoder):
    """The vectors of n-grams and of a sentence encoder, concatenated; each is half of the whole.

    Args:
        ngrams: factory of the n-grams, called with `width`.
        sentence: factory of the sentence encoder, called with `width`.
        width: length of the vector.

    Raises:
        UserError: the n-grams have word dropout, whose tokens are too large for a tensor of floats.
    """

    def __init__(self, ngrams: Callable[..., NGrams], sentence: Callable[..., HuggingFace], *, width: int) -> None:
        super().__init__(width)
        self.ngrams, self.sentence = ngrams(width=width // 2), sentence(width=width - width // 2)
        if self.ngrams.word_dropout is not None:
            raise UserError("model.text.ngrams.word_dropout must be null beside a sentence encoder")

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return (B, E + L) float32: frozen vectors, and hashes of n-grams, below 2^24 and therefore exact."""
        return torch.cat([self.sentence.tokenize(sentences), self.ngrams.tokenize(sentences).float()], 1)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, width) vectors for the (B, E + L) output of `tokenize`."""
        length = self.sentence.length
        return torch.cat([self.ngrams(tokens[:, length:].long()), self.sentence(tokens[:, :length])], 1)
