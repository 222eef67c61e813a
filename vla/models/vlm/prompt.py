"""Prompts: sentences, and for some models the state, as tokens of a pretrained language model.

Shapes: B sentences, L tokens, S components of the state, W tokens of the longest number.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from pathlib import Path
from typing import Any

import torch
from tokenizers import Tokenizer
from torch import Tensor

from vla.io.documents import lines_of, read_bounded
from vla.io.errors import UserError
from vla.io.types import Steps, Text
from vla.models.hub import fetch
from vla.models.text.ngrams import TextEncoder, padding_last

PADDING = -1
FILE = "tokenizer.json"
WORDS = 4096  # hashes of words, where no tokenizer is named
STEP = 16  # lengths are multiples of it [tokens]: few, so that a program compiled for each can be kept
BINS = 256  # of a normalised state in -1 … 1
SAMPLE_PROMPT = "Task: pick it up, State: -1 0 255;\nAction: "


class Prompt(TextEncoder):
    """A sentence as a line of its own, cut to L tokens.

    With `state` it is "Task: SENTENCE, State: NUMBERS;\\nAction: ", as π0.5 has it: the numbers of bins of the state.
    Tokens of the numbers are looked up and inserted on the device of the state, so that no plan has to tokenize a text.

    Args:
        name: folder with the tokenizer.json of the language model, or its name on the hub, OWNER/NAME or
            OWNER/NAME@REVISION; null: the tokens are hashes of words, for a vocabulary of `WORDS`.
        length: L.
        state: whether the state is part of the prompt.
        width: unused.

    Raises:
        UserError: there is no such tokenizer.
    """

    vectors = False

    numbers: Tensor  # (BINS + 1, W) tokens of " -1" to " 255"
    end: Tensor  # tokens after the numbers

    def __init__(self, name: Text | None, length: Steps, state: bool, *, width: int) -> None:
        super().__init__(width)
        self.name, self.length, self.state = name, length, state
        self._tokenizer, self._sha256 = (None, None) if name is None else _tokenizer(name)
        if state:
            number_ids = [self._ids(f" {number}", special=False) for number in range(-1, BINS)]
            self.register_buffer("numbers", _padded_tensor(number_ids, max(map(len, number_ids))), persistent=False)
            self.register_buffer("end", torch.tensor(self._ids(";\nAction: ", special=False)), persistent=False)
            tried_ids = self._ids("Task: pick it up, State:", special=True)
            tried_ids = tried_ids + number_ids[0] + number_ids[1] + number_ids[-1] + self.end.tolist()
            if tried_ids != self._ids(SAMPLE_PROMPT, special=True):
                raise UserError(
                    f"the tokenizer of {name} does not read numbers one by one, as {SAMPLE_PROMPT!r} needs: "
                    "choose another one"
                )

    @property
    def words(self) -> int:
        """Size of the vocabulary that sentences need."""
        vocabulary = {} if self._tokenizer is None else self._tokenizer.get_vocab(with_added_tokens=False)
        return 1 + max(vocabulary.values(), default=WORDS - 1)

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return (B, L) int64 tokens, `PADDING` after the end; L is the longest sentence rounded up to `STEP`s."""
        texts = [
            f"Task: {_clean(text)}, State:" if self.state else text.removesuffix("\n") + "\n" for text in sentences
        ]
        rows = [self._ids(text, special=True)[: self.length] for text in texts]
        longest = max(map(len, rows))
        return _padded_tensor(rows, min(self.length, -longest % STEP + longest))

    def forward(self, tokens: Tensor, state: Tensor | None = None) -> Tensor:
        """Return the tokens of whole prompts, (B, ≤ L), from the output of `tokenize` and the (B, S) scaled state."""
        if not self.state:
            return tokens
        assert state is not None
        edges = torch.arange(BINS, device=state.device) * (2 / BINS) - 1
        bins = torch.bucketize(state.contiguous(), edges, right=True)  # 0 is below -1
        parts = [tokens, self.numbers[bins].flatten(1), self.end.expand(len(tokens), -1)]
        return padding_last(torch.cat(parts, 1), PADDING)[:, : self.length]

    def _ids(self, text: str, special: bool) -> list[int]:
        if self._tokenizer is None:
            return [zlib.crc32(word.encode()) % WORDS for word in re.findall(r"\w+|[^\w\s]|\n", text.lower())]
        return self._tokenizer.encode(text, add_special_tokens=special).ids

    def get_extra_state(self) -> dict[str, Any]:
        """Return what identifies the tokenizer."""
        return {"sha256": self._sha256}

    def set_extra_state(self, state: Any) -> None:
        """Raise a UserError if the tokenizer differs from the one in training."""
        digest = state.get("sha256") if isinstance(state, dict) else self._sha256
        if digest != self._sha256:
            raise UserError(f"the {FILE} of {self.name} is another than in training: its SHA-256 is not {digest}")


def _clean(sentence: str) -> str:
    return sentence.strip().replace("_", " ").replace("\n", " ")


def _padded_tensor(rows: list[list[int]], length: int) -> Tensor:
    return torch.tensor([row + [PADDING] * (length - len(row)) for row in rows])


def _tokenizer(name: str) -> tuple[Tokenizer, str]:
    """Return the tokenizer in a folder or on the hub, and the SHA-256 of its file."""
    advice = f"nor is it a folder here: set model.text.name to a folder with its {FILE}"
    path = (Path(name) if Path(name).is_dir() else fetch(name, FILE, advice=advice)) / FILE
    try:
        content = read_bounded(path)
        tokenizer = Tokenizer.from_buffer(content)
    except Exception as error:  # tokenizers raises Exception itself
        raise UserError(f"{path} is no tokenizer: {lines_of(error)[0][:200]}") from error
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer, hashlib.sha256(content).hexdigest()
