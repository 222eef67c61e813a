"""Sentences as vectors.

Shapes: B sentences, L numbers that stand for one of them, such as the n-grams of the longest.
"""

from __future__ import annotations

import re
import zlib
from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor, nn

from vla.types import Count, Rate

PADDING = 0
KEPT = 8192  # sentences whose numbers are remembered: 70 MB where all are as long as instructions may be
INITIAL = 0.1  # deviation of vectors before training: small, so that unknown n-grams hardly say anything


class TextEncoder(nn.Module, ABC):
    """Sentence → vector in two halves: `tokenize` in plain Python, and `forward`, which compiles and trains.

    Args:
        width: length of the vector.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    @abstractmethod
    def tokenize(self, sentences: list[str]) -> Tensor:
        """What `forward` reads of B sentences, (B, L)."""

    @abstractmethod
    def forward(self, tokens: Tensor) -> Tensor:
        """(B, width) vectors for the (B, L) of `tokenize`."""


class NGrams(TextEncoder):
    """The mean of learned vectors, one for each hashed word and n-gram of the sentence; needs no download.

    Words the training never saw still share n-grams of characters with known ones, and three words at a time tell "put
    the red block on the blue block" from "put the blue block on the red block", which have the same pairs of words.

    Args:
        vocabulary: number of learned vectors; n-grams that hash to the same one share it.
        words: longest n-gram of words.
        characters: length of the n-grams of characters, taken from every word between its boundary marks.
        forget: share of the n-grams that a sentence goes without in training, as one with unknown words will.
        width: length of the sentence vector.
    """

    def __init__(
        self,
        vocabulary: Annotated[int, Ge(2), Le(2**24)] = 4096,
        words: Count = 3,
        characters: Count = 3,
        forget: Rate = 0.0,
        *,
        width: int,
    ) -> None:
        super().__init__(width)
        if not 0 <= forget < 1:
            raise ValueError(f"forget is a share of the n-grams from 0 up to 1, got {forget}")
        if vocabulary < 2 or words < 1 or characters < 1:
            raise ValueError(
                f"n-grams need vocabulary >= 2, words >= 1 and characters >= 1, "
                f"got vocabulary={vocabulary}, words={words}, characters={characters}"
            )
        self.vocabulary, self.words, self.characters, self.forget = vocabulary, words, characters, forget
        self.embedding = nn.Embedding(vocabulary, width, padding_idx=PADDING)
        with torch.no_grad():
            self.embedding.weight.mul_(INITIAL)
        self.norm = nn.LayerNorm(width)

    def tokenize(self, sentences: list[str]) -> Tensor:
        """(B, L) int64 hashes of the n-grams of B sentences, whatever their case, filled up with 0."""
        rows = [_hashes(sentence, self.vocabulary, self.words, self.characters) for sentence in sentences]
        return nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=PADDING)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, width) vectors for (B, L) tokens, wherever 0s stand among them."""
        if self.training and self.forget:
            tokens = tokens * (torch.rand(tokens.shape, device=tokens.device) >= self.forget)
        count = (tokens != PADDING).sum(1, keepdim=True).clamp(min=1)
        vector: Tensor = self.norm(self.embedding(tokens).sum(1) / count)
        return vector


@lru_cache(maxsize=KEPT)
def _hashes(sentence: str, vocabulary: int, words: int, characters: int) -> Tensor:
    found = re.findall(r"\w+", sentence.lower())
    grams = [" ".join(found[i : i + n]) for n in range(1, words + 1) for i in range(len(found) - n + 1)]
    for word in found:
        marked = f"<{word}>"
        grams += [f"#{marked[i : i + characters]}" for i in range(len(marked) - characters + 1)]
    # crc32 and not hash(): the same in every process, so that a checkpoint means the same tomorrow.
    return torch.tensor([1 + zlib.crc32(gram.encode()) % (vocabulary - 1) for gram in grams] or [PADDING])
