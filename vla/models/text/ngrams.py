"""Text encoders: the base class, and learned embeddings of n-grams.

Shapes: B sentences, L tokens of the longest, such as its n-grams.
"""

from __future__ import annotations

import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor, nn

from vla.io.types import Rate
from vla.models.text.tensor_cache import TensorCache

PADDING = 0
CACHE = TensorCache(64 << 20)  # of the hashes of sentences, about 1.5 kB each
INITIAL_STD = 0.1  # of embeddings; small, so that untrained n-grams have little effect


class TextEncoder(nn.Module, ABC):
    """Sentence → vector in two parts: `tokenize` in plain Python, and `forward`, which is compiled and trained.

    Args:
        width: length of the vector.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    @abstractmethod
    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return the input of `forward` for B sentences, (B, L)."""

    @abstractmethod
    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, width) vectors for the (B, L) output of `tokenize`."""


class HashEmbedding(TextEncoder):
    """Base class of encoders with learned embeddings of hashed n-grams.

    Args:
        vocabulary: number of embeddings.
        dropout: rate at which n-grams are dropped in training.
        width: length of the sentence vector.
    """

    def __init__(self, vocabulary: int, dropout: float, width: int) -> None:
        super().__init__(width)
        self.vocabulary, self.dropout = vocabulary, dropout
        self.embedding = nn.Embedding(vocabulary, width, padding_idx=PADDING)
        with torch.no_grad():
            self.embedding.weight.mul_(INITIAL_STD)
        self.norm = nn.LayerNorm(width)

    def average(self, rows: Tensor) -> Tensor:
        """Return the normalised means, (B, width), of the embeddings of (B, L) rows; 0 is ignored at any position."""
        if self.training and self.dropout:
            rows = rows * (torch.rand(rows.shape, device=rows.device) >= self.dropout)
        count = (rows != PADDING).sum(1, keepdim=True).clamp(min=1)
        return self.norm(self.embedding(rows).sum(1) / count)


class NGrams(HashEmbedding):
    """Mean of learned embeddings of the hashed words and n-grams of a sentence; needs no download.

    Unseen words share character n-grams with known ones. Trigrams of words distinguish "put the red block on the blue
    block" from "put the blue block on the red block", which have the same bigrams.

    Args:
        vocabulary: number of embeddings; n-grams with the same hash share one.
        words: longest n-gram of words.
        characters: length of character n-grams, taken from every word with boundary marks.
        dropout: rate at which n-grams are dropped in training, which imitates unknown words.
        width: length of the sentence vector.
    """

    def __init__(
        self,
        vocabulary: Annotated[int, Ge(2), Le(2**24)],
        words: Annotated[int, Ge(1), Le(16)],
        characters: Annotated[int, Ge(1), Le(32)],
        dropout: Rate,
        *,
        width: int,
    ) -> None:
        super().__init__(vocabulary, dropout, width)
        self.words, self.characters = words, characters

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return (B, L) int64 hashes of the n-grams of B lower-cased sentences, padded with 0."""
        sizes = self.vocabulary, self.words, self.characters
        return padded(sentences, lambda sentence: _hashes(sentence, *sizes), *sizes)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, width) vectors for (B, L) tokens; 0 is ignored at any position."""
        return self.average(tokens)


def padded(sentences: list[str], hashes: Callable[[str], list[int]], *options: Hashable) -> Tensor:
    """Return (B, L) int64 hashes of B sentences, padded with 0; they are cached by sentence and options."""
    rows = [CACHE.get(each, lambda each=each: torch.tensor(hashes(each) or [PADDING]), *options) for each in sentences]
    return nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=PADDING)


def words_of(sentence: str) -> list[str]:
    """Return the words of a sentence in lower case."""
    return re.findall(r"\w+", sentence.lower())


def _hashes(sentence: str, vocabulary: int, words: int, characters: int) -> list[int]:
    """Return the L hashes of the n-grams of a sentence."""
    found = words_of(sentence)
    grams = [" ".join(found[i : i + n]) for n in range(1, words + 1) for i in range(len(found) - n + 1)]
    for word in found:
        marked = f"<{word}>"
        grams += [f"#{marked[i : i + characters]}" for i in range(len(marked) - characters + 1)]
    # crc32, because hash() differs between processes.
    return [1 + zlib.crc32(gram.encode()) % (vocabulary - 1) for gram in grams]
