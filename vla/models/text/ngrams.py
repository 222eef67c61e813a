"""Text encoders: the base class, and learned embeddings of n-grams.

Shapes: B sentences, L tokens of the longest, such as its n-grams or its W words.
"""

from __future__ import annotations

import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Rate
from vla.models.text.colours import to_basic_terms

PADDING = 0
CHARACTERS = 3  # length of character n-grams
CACHE_SIZE = 1 << 13  # sentences whose hashes are cached: 1.5 kB each, 10 kB for the longest
INITIAL_STD = 0.1  # of embeddings; small, so that untrained n-grams have little effect
PRIME, FACTOR = 2**31 - 1, 1_000_003  # of the polynomial hash of n-grams; its products fit into 64 bits


class TextEncoder(nn.Module, ABC):
    """Sentence → vector in two parts: `tokenize` in plain Python, and `forward`, which is compiled and trained.

    Args:
        width: length of the vector.
    """

    vectors = True  # else `forward` returns tokens, for a model that reads them itself

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    @abstractmethod
    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return the input of `forward` for B sentences, (B, L)."""

    @abstractmethod
    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, width) vectors for the (B, L) output of `tokenize`."""


class NGrams(TextEncoder):
    """Mean of learned embeddings of the hashed words and n-grams of a sentence; needs no download.

    Trigrams of words distinguish "put the red block on the blue block" from "put the blue block on the red block",
    which have the same bigrams. Words that do not occur in training are treated in one of two ways:

    - They share n-grams of characters with known ones.
    - With `word_dropout` there are no n-grams of characters, and unknown words are left out before n-grams are taken:
      "put the red brick on the pad" becomes "put the red on the pad". Word dropout (Iyyer et al., Deep Unordered
      Composition, ACL 2015) produces such sentences in training.

    Args:
        vocabulary: number of embeddings; n-grams with the same hash share one.
        words: longest n-gram of words.
        dropout: rate at which n-grams are dropped in training, which imitates unknown words.
        word_dropout: rate at which words are left out in training; None: unknown words are not left out.
        basic_colours: whether names of colours are replaced by basic terms, see `vla.models.text.colours`.
        synonyms: replacement → words that it replaces, such as "pick up" → "grab" and "lift"; "" removes its words.
        width: length of the sentence vector.

    Raises:
        UserError: `synonyms` has a word more than once.
    """

    heard: Tensor  # (vocabulary,) bool: rows of the words seen in training; None without word dropout

    def __init__(
        self,
        vocabulary: Annotated[int, Ge(2), Le(2**24)],
        words: Annotated[int, Ge(1), Le(16)],
        dropout: Rate,
        word_dropout: Rate | None,
        basic_colours: bool,
        synonyms: Mapping[str, Sequence[str]],
        *,
        width: int,
    ) -> None:
        super().__init__(width)
        self.vocabulary, self.words, self.basic_colours = vocabulary, words, basic_colours
        self.dropout, self.word_dropout = dropout, word_dropout
        self.replaced = tuple(_replacements(synonyms).items())  # in the order in which they are looked for
        self.embedding = nn.Embedding(vocabulary, width, padding_idx=PADDING)
        with torch.no_grad():
            self.embedding.weight.mul_(INITIAL_STD)
        self.norm = nn.LayerNorm(width)
        self.register_buffer("heard", None if word_dropout is None else torch.zeros(vocabulary, dtype=torch.bool))

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return (B, L) int64 hashes, padded with 0: of n-grams, or with word dropout of words, case ignored."""
        words = None if self.word_dropout is not None else self.words
        rows = [_hashes(sentence, self.vocabulary, words, self.basic_colours, self.replaced) for sentence in sentences]
        return nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=PADDING)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, width) vectors for (B, L) tokens; 0 is ignored at any position."""
        rows = tokens
        if self.word_dropout is not None:
            rows = self._rows(_ngram_hashes(self._drop_words(tokens, self.word_dropout), self.words))
        if self.training and self.dropout:
            rows = rows * (torch.rand(rows.shape, device=rows.device) >= self.dropout)
        count = (rows != PADDING).sum(1, keepdim=True).clamp(min=1)
        return self.norm(self.embedding(rows).sum(1) / count)

    def _drop_words(self, tokens: Tensor, rate: float) -> Tensor:
        """Drop words from (B, W) tokens: in training at random, at `rate`, otherwise those unknown from training. None
        is dropped without any training, as of a frozen encoder."""
        rows = self._rows(tokens)
        if self.training:
            self.heard.index_fill_(0, rows.flatten(), True)  # in each process; those of the first one are saved
            mask = torch.rand(tokens.shape, device=tokens.device) < rate
        else:
            mask = ~self.heard[rows] & self.heard.any()
        return padding_last(tokens.masked_fill(mask, PADDING), PADDING)

    def _rows(self, hashes: Tensor) -> Tensor:
        """Return the rows of the embedding for hashes below 2^31."""
        return torch.where(hashes == PADDING, PADDING, 1 + hashes % (self.vocabulary - 1))


def words_of(sentence: str) -> list[str]:
    """Return the words of a sentence in lower case."""
    return re.findall(r"\w+", sentence.lower())


def _replacements(synonyms: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return words → their replacement, the longest first; replacements are mapped to themselves."""
    pairs = [(word.lower(), term.lower()) for term, variants in synonyms.items() for word in (term, *variants) if word]
    if duplicates := sorted({word for word, _ in pairs if sum(word == name for name, _ in pairs) > 1}):
        raise UserError(f"model.text.synonyms has {', '.join(map(repr, duplicates))} more than once: omit all but one")
    return dict(sorted(pairs, key=lambda pair: -len(pair[0])))


@lru_cache(CACHE_SIZE)
def _hashes(
    sentence: str, vocabulary: int, longest: int | None, basic_colours: bool, replacements: tuple[tuple[str, str], ...]
) -> Tensor:
    """Return the hashes of n-grams of up to `longest` words and of characters, or, if it is None, of the words."""
    if replacements:
        table = dict(replacements)
        sentence = re.sub(rf"\b(?:{'|'.join(map(re.escape, table))})\b", lambda word: table[word[0]], sentence.lower())
    words = to_basic_terms(words_of(sentence)) if basic_colours else words_of(sentence)
    # crc32, because hash() differs between processes.
    if longest is None:
        return torch.tensor([1 + zlib.crc32(word.encode()) % (PRIME - 1) for word in words] or [PADDING])
    grams = [*_word_ngrams(words, longest), *_character_ngrams(words)]
    return torch.tensor([1 + zlib.crc32(gram.encode()) % (vocabulary - 1) for gram in grams] or [PADDING])


def _word_ngrams(words: list[str], longest: int) -> list[str]:
    return [" ".join(words[i : i + n]) for n in range(1, longest + 1) for i in range(len(words) - n + 1)]


def _character_ngrams(words: list[str]) -> list[str]:
    """Return the character n-grams of every word with its ends marked; the prefix # tells them from words."""
    marked_words = [f"<{word}>" for word in words]
    return [f"#{word[i : i + CHARACTERS]}" for word in marked_words for i in range(len(word) - CHARACTERS + 1)]


def padding_last(tokens: Tensor, padding: int) -> Tensor:
    """Move the padding of (B, L) tokens to the end of each row."""
    length = tokens.shape[1]
    places = torch.arange(length, device=tokens.device)
    return tokens.gather(1, torch.where(tokens == padding, places + length, places).argsort(1))


def _ngram_hashes(tokens: Tensor, longest: int) -> Tensor:
    """Return hashes of the n-grams of up to `longest` of (B, W) tokens, (B, L); `PADDING` where a row is too short."""
    length = tokens.shape[1]
    padded = nn.functional.pad(tokens, (0, longest - 1), value=PADDING)
    grams = [tokens]
    for offset in range(1, longest):
        next_tokens = padded[:, offset : offset + length]
        grams.append(torch.where(next_tokens == PADDING, PADDING, (grams[-1] * FACTOR + next_tokens) % PRIME))
    return torch.cat(grams, 1)
