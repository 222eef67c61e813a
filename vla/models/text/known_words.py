"""N-grams of the words that occur in training; unseen words are left out.

Shapes: B sentences, W words of the longest, L n-grams.
"""

from __future__ import annotations

import zlib
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor, nn

from vla.io.types import Rate
from vla.models.text.colours import simplified
from vla.models.text.ngrams import PADDING, HashEmbedding, padded, words_of

PRIME, FACTOR = 2**31 - 1, 1_000_003  # of the polynomial hash of n-grams; its products fit into 64 bits


class KnownWords(HashEmbedding):
    """Mean of learned embeddings of the hashed n-grams of the words seen in training.

    Any other word is left out before n-grams are taken: "put the red brick on the pad" becomes "put the red on the
    pad". Word dropout (Iyyer et al., Deep Unordered Composition, ACL 2015) produces such sentences in training.

    Args:
        vocabulary: number of embeddings; n-grams with the same hash share one.
        words: longest n-gram of words.
        dropout: rate at which n-grams are dropped in training.
        word_dropout: rate at which words are left out in training.
        basic_colours: whether names of colours are replaced by basic terms, see `vla.models.text.colours`.
        width: length of the sentence vector.
    """

    heard: Tensor  # (vocabulary,) bool: hashes of the words seen in training

    def __init__(
        self,
        vocabulary: Annotated[int, Ge(2), Le(2**24)],
        words: Annotated[int, Ge(1), Le(16)],
        dropout: Rate,
        word_dropout: Rate,
        basic_colours: bool,
        *,
        width: int,
    ) -> None:
        super().__init__(vocabulary, dropout, width)
        self.words, self.word_dropout, self.basic_colours = words, word_dropout, basic_colours
        self.register_buffer("heard", torch.zeros(vocabulary, dtype=torch.bool))

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return (B, W) int64 hashes of the words of B lower-cased sentences, padded with 0."""
        if self.basic_colours:
            sentences = [simplified(sentence) for sentence in sentences]
        return padded(sentences, _hashes, KnownWords)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, width) vectors for (B, W) tokens; 0 is ignored at any position."""
        rows = self._rows(tokens)
        if self.training:
            self.heard.index_fill_(0, rows.flatten(), True)  # each process its own; those of the first are saved
            left_out = torch.rand(tokens.shape, device=tokens.device) < self.word_dropout
        else:
            left_out = ~self.heard[rows]
        known = _shifted_left(tokens.masked_fill(left_out, PADDING))
        return self.average(self._rows(_ngrams(known, self.words)))

    def _rows(self, hashes: Tensor) -> Tensor:
        """Return the rows of the embedding for hashes."""
        return torch.where(hashes == PADDING, PADDING, 1 + hashes % (self.vocabulary - 1))


def _hashes(sentence: str) -> list[int]:
    """Return the hashes of the words of a sentence, from 1 to 2^31 - 2."""
    # crc32, because hash() differs between processes.
    return [1 + zlib.crc32(word.encode()) % (PRIME - 1) for word in words_of(sentence)]


def _shifted_left(tokens: Tensor) -> Tensor:
    """Move the padding of (B, W) tokens to the end of each row."""
    length = tokens.shape[1]
    places = torch.arange(length, device=tokens.device)
    return tokens.gather(1, torch.where(tokens == PADDING, places + length, places).argsort(1))


def _ngrams(tokens: Tensor, longest: int) -> Tensor:
    """Return hashes of the n-grams of up to `longest` of (B, W) tokens, (B, L); `PADDING` where a row is too short."""
    length = tokens.shape[1]
    padded = nn.functional.pad(tokens, (0, longest - 1), value=PADDING)
    grams = [tokens]
    for further in range(1, longest):
        following = padded[:, further : further + length]
        grams.append(torch.where(following == PADDING, PADDING, (grams[-1] * FACTOR + following) % PRIME))
    return torch.cat(grams, 1)
