"""FAST: a chunk of actions as a short token sequence, by cosine transform and byte-pair encoding (arXiv 2501.09747).

Shapes: k actions of a chunk, D action components, L tokens of a sequence, K of the vocabulary, … leading dimensions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer
from tokenizers.models import BPE
from tokenizers.trainers import BpeTrainer
from torch import Tensor

from vla.io.errors import UserError
from vla.io.types import Bins, Positive, Steps
from vla.models.layers import exact_product
from vla.models.tokenizers.tokenizer import MIN_SPAN, ActionTokenizer, data_bounds
from vla.spec import ActionStatistics, Spec

FIRST_CODE_POINT = 0x100  # of the smallest coefficient
MOST_VALUES = 0xD800 - FIRST_CODE_POINT  # of coefficients; below 0xD800 every code point is a character
END = "<end>"
QUANTILES = (0.01, 0.99)  # of the data, scaled to -1 and 1


class Fast(ActionTokenizer):
    """Byte-pair encoding of the rounded cosine transform of each component, low frequencies first.

    Smooth motions have few non-zero coefficients, and byte-pair encoding merges frequent sequences, so the length
    varies, up to k·D tokens and an end token. In generated sequences, missing coefficients are 0, surplus ones dropped.

    A chunk counts in the loss as a whole, and only if nothing in it is perturbed.

    Args:
        bins: K: the end token, one token per coefficient value, and merged sequences.
        scale: quantisation steps per unit of the scaled actions; a larger value is finer and needs more tokens.
        chunk: k.
        spec: gives the allowed range of actions.
        statistics: the data; None if a checkpoint is loaded next.
    """

    end = 0
    centre: Tensor  # (D,) of the scaled range, in the units of the action
    spread: Tensor  # (D,) half of the scaled range, in the units of the action
    basis: Tensor  # (k, k) orthonormal cosine transform of type II: frequency, time

    def __init__(
        self, bins: Bins, scale: Positive, chunk: Steps, *, spec: Spec, statistics: ActionStatistics | None = None
    ) -> None:
        low, high = data_bounds(spec, statistics)
        super().__init__(spec, low, high, bins)
        self.scale, self.chunk = scale, chunk
        sample = np.stack([low, high])[:, None].repeat(chunk, 1) if statistics is None else statistics.chunks(chunk)
        lower, upper = np.quantile(sample.astype(np.float64), QUANTILES, axis=(0, 1))
        allowed_span = np.array(spec.high) - np.array(spec.low)
        self.register_buffer("centre", torch.as_tensor((lower + upper) / 2, dtype=torch.float32))
        self.register_buffer(
            "spread", torch.as_tensor(np.maximum(upper - lower, MIN_SPAN * allowed_span) / 2, dtype=torch.float32)
        )
        self.register_buffer("basis", cosines(chunk), persistent=False)
        self._minimum, self._maximum = 0, 0  # coefficients
        self._bpe, self._pieces = Tokenizer(BPE()), [""]
        if statistics is not None:
            self._fit(torch.from_numpy(np.ascontiguousarray(sample, np.float32)))

    def length(self, chunk: int) -> int:
        """Return k·D + 1: one token per coefficient and the end token.

        Raises:
            UserError: the tokenizer was fitted on chunks of another length.
        """
        if chunk != self.chunk:
            raise UserError(
                f"the model has chunks of {chunk}, its tokenizer of {self.chunk}: set tokenizer.chunk={chunk}"
            )
        return chunk * self.components + 1

    @torch.compiler.disable
    def tokenize(self, actions: Tensor) -> Tensor:
        """Encode (…, k, D) float chunks, clipped to the bounds, as (…, L) int64 tokens, padded with the end token."""
        texts = self._texts(self._round(actions).clamp(self._minimum, self._maximum))  # to the alphabet
        token_ids = [encoding.ids for encoding in self._bpe.encode_batch(texts, add_special_tokens=False)]
        length = 1 + max(len(ids) for ids in token_ids)
        rows = [ids + [self.end] * (length - len(ids)) for ids in token_ids]
        return torch.tensor(rows, device=actions.device).view(*actions.shape[:-2], length)

    @torch.compiler.disable
    def detokenize(self, tokens: Tensor) -> Tensor:
        """Decode (…, L) tokens up to the first end token, if any, as (…, k, D) float actions."""
        count = self.chunk * self.components
        rows = []
        for ids in tokens.reshape(-1, tokens.shape[-1]).tolist():
            ids = ids[: ids.index(self.end)] if self.end in ids else ids
            text = "".join(self._pieces[token] for token in ids if token < len(self._pieces))[:count]
            values = [ord(character) - FIRST_CODE_POINT + self._minimum for character in text]
            rows.append(values + [0] * (count - len(values)))
        coefficients = torch.tensor(rows, dtype=torch.float32, device=tokens.device)
        scaled = exact_product(self.basis.T, coefficients.view(-1, self.chunk, self.components)) / self.scale
        return (scaled * self.spread + self.centre).view(*tokens.shape[:-1], self.chunk, self.components)

    def loss_mask(self, tokens: Tensor, perturbations: Tensor) -> Tensor:
        """Return the (…, L) bool loss mask: tokens up to the first end token of chunks in which nothing is perturbed.

        Every token depends on all actions of a chunk, including those that repeat the last one of an episode.
        """
        end_counts = (tokens == self.end).cumsum(-1)
        unperturbed = perturbations.amax(-1) == 0
        return ((end_counts == 0) | ((end_counts == 1) & (tokens == self.end))) & unperturbed[..., None]

    def get_extra_state(self) -> dict[str, Any]:
        """Return the fitted values that are not tensors, for the checkpoint."""
        return {"coefficients": [self._minimum, self._maximum], "bpe": self._bpe.to_str()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the fitted values; a UserError if they are damaged."""
        if type(state).__name__ == "_EXTRA_STATE":  # PyTorch's placeholder in sharded models, with nothing to load
            return
        try:
            self._minimum, self._maximum = map(int, state["coefficients"])
            if not (abs(self._minimum) < 2**31 and 0 <= self._maximum - self._minimum < MOST_VALUES):
                raise ValueError("its coefficients are no range that there are characters for")
            self._set_bpe(Tokenizer.from_str(state["bpe"]))
        except Exception as error:  # tokenizers raises a plain Exception for invalid text
            raise UserError(f"the tokenizer of the policy cannot be read: {str(error)[:200]}") from error

    def _fit(self, chunks: Tensor) -> None:
        coefficients = self._round(chunks)
        self._minimum, self._maximum = int(coefficients.min()), int(coefficients.max())
        count = self._maximum - self._minimum + 1
        if count > (limit := min(self.bins - 1, MOST_VALUES)):
            raise UserError(
                f"the coefficients take {count} values, and tokenizer.bins={self.bins} can tell {limit} apart: "
                f"raise it, or lower tokenizer.scale={self.scale}"
            )
        alphabet = [chr(FIRST_CODE_POINT + number) for number in range(count)]
        bpe = Tokenizer(BPE())
        trainer = BpeTrainer(vocab_size=self.bins, special_tokens=[END], initial_alphabet=alphabet, show_progress=False)
        bpe.train_from_iterator(self._texts(coefficients), trainer)
        self._set_bpe(bpe)

    def _set_bpe(self, bpe: Tokenizer) -> None:
        bpe.no_padding()  # which a file could ask for, to any length
        bpe.no_truncation()
        self._bpe = bpe
        vocabulary = sorted(bpe.get_vocab().items(), key=lambda item: item[1])
        self._pieces = ["" if number == self.end else piece for piece, number in vocabulary]

    def _round(self, actions: Tensor) -> Tensor:
        """Transform (…, k, D) actions to (…, k, D) rounded coefficients, by frequency and component.

        Less than full precision would change some coefficients.
        """
        clipped_actions = actions.clamp(self.low, self.high)
        return (exact_product(self.basis, (clipped_actions - self.centre) / self.spread) * self.scale).round()

    def _texts(self, coefficients: Tensor) -> list[str]:
        """Convert (…, k, D) coefficients to one text of k·D characters per chunk."""
        codes = (coefficients - self._minimum + FIRST_CODE_POINT).long().reshape(-1, self.chunk * self.components)
        return ["".join(map(chr, row)) for row in codes.tolist()]


def cosines(count: int) -> Tensor:
    """Return the (count, count) orthonormal cosine transform of type II: rows are frequencies, columns times."""
    index = torch.arange(count, dtype=torch.float64)
    waves = torch.cos(torch.pi / count * (index + 0.5) * index[:, None]) * (2 / count) ** 0.5
    waves[0] /= 2**0.5
    return waves.float()
