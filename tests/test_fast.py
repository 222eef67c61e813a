"""Chunks as byte pairs of their frequencies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from fake_batch import MOTIONS
from tokenizers import Tokenizer
from toy import SPEC

from vla.io.errors import UserError
from vla.models.tokenizers.fast import Fast, cosines

CHUNKS = torch.from_numpy(MOTIONS.chunks(8).copy())
TOKENIZER = Fast(spec=SPEC, statistics=MOTIONS, bins=1024, scale=10.0, chunk=8)


def test_cosines_are_the_transform_of_the_book() -> None:
    moments = np.arange(6)
    for frequency, row in enumerate(cosines(6).numpy()):
        wave = np.cos(np.pi * (moments + 0.5) * frequency / 6)
        assert row == pytest.approx(wave / np.linalg.norm(wave), abs=1e-6)


def test_fast_needs_fewer_tokens_than_there_are_components() -> None:
    tokens = TOKENIZER.tokenize(CHUNKS)
    written = TOKENIZER.loss_mask(tokens, torch.zeros(len(CHUNKS), 8, dtype=torch.long)).sum(1)
    assert written.float().mean() < 0.6 * 8 * 3 and written.max() <= 25
    ends = tokens.gather(1, written[:, None] - 1)
    assert (ends == TOKENIZER.end).all()


def test_fast_writes_the_same_in_mixed_precision() -> None:
    tokens = TOKENIZER.tokenize(CHUNKS)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(TOKENIZER.tokenize(CHUNKS), tokens)
        assert TOKENIZER.detokenize(tokens).dtype == torch.float32


def test_fast_is_finer_with_a_larger_scale() -> None:
    errors = []
    for scale in (5.0, 20.0):
        tokenizer = Fast(scale=scale, spec=SPEC, statistics=MOTIONS, bins=1024, chunk=8)
        errors.append((tokenizer.detokenize(tokenizer.tokenize(CHUNKS)) - CHUNKS)[..., :2].abs().mean().item())
    assert errors[1] < 0.4 * errors[0]


def test_fast_makes_actions_of_whatever_a_model_writes() -> None:
    random = torch.Generator().manual_seed(0)
    anything = torch.randint(TOKENIZER.bins, (50, 25), generator=random)
    assert torch.isfinite(TOKENIZER.detokenize(anything)).all()
    nothing = torch.zeros(1, 1, dtype=torch.int64)
    mean = TOKENIZER.detokenize(nothing)
    assert mean.shape == (1, 8, 3) and torch.allclose(mean[0, 0], mean[0, 7])  # all coefficients are 0
    whole = TOKENIZER.tokenize(CHUNKS[:1])
    short = whole[:, : int((whole != TOKENIZER.end).sum()) - 2]
    longer = torch.cat([whole[whole != TOKENIZER.end][None], whole], 1)
    assert torch.equal(TOKENIZER.detokenize(longer), TOKENIZER.detokenize(whole))
    assert TOKENIZER.detokenize(short).shape == (1, 8, 3)
    wild = torch.tensor([9.0, -9.0, 5.0]) * torch.tensor([1.0, -1.0] * 4)[:, None]  # which the data never had
    assert torch.isfinite(TOKENIZER.detokenize(TOKENIZER.tokenize(wild))).all()


def test_a_chunk_counts_as_a_whole() -> None:
    tokens = TOKENIZER.tokenize(CHUNKS[:3])
    ended, perturbed, absent = [0, 0, 0, -1, -1, -1, -1, -1], [0, 0, 0, 1, 1, 1, 1, 1], [-1] * 8
    counted = TOKENIZER.loss_mask(tokens, torch.tensor([ended, perturbed, absent]))
    assert counted[0].sum() == (tokens[0] != TOKENIZER.end).sum() + 1 and not counted[1:].any()


@pytest.mark.parametrize(("bins", "scale", "most"), [(8, 10.0, 7), (1024, 1e6, 1023), (65536, 1e5, 55040)])
def test_more_values_than_there_are_tokens_or_characters_are_refused(bins: int, scale: float, most: int) -> None:
    with pytest.raises(UserError, match=rf"tokenizer\.bins={bins} can tell {most} apart: .*lower tokenizer\.scale"):
        Fast(bins=bins, spec=SPEC, statistics=MOTIONS, scale=scale, chunk=8)


def test_chunks_of_another_length_are_refused() -> None:
    with pytest.raises(UserError, match=r"has chunks of 4, its tokenizer of 8: set tokenizer\.chunk=4"):
        TOKENIZER.length(4)


DAMAGED: list[dict[str, Any]] = [
    {"coefficients": None},
    {"coefficients": [-(10**400), 1]},
    {"coefficients": [-(2**30), 1]},  # the text of a chunk would need characters that there are not
    {"bpe": "{"},
]


@pytest.mark.parametrize("change", DAMAGED, ids=["coefficients", "size", "range", "byte pairs"])
def test_a_damaged_vocabulary_is_refused(change: dict[str, Any]) -> None:
    tokenizer = Fast(spec=SPEC, bins=1024, scale=10.0, chunk=8)
    with pytest.raises(UserError, match="the tokenizer of the policy cannot be read"):
        tokenizer.set_extra_state({**TOKENIZER.get_extra_state(), **change})


def test_a_file_does_not_lengthen_sequences() -> None:
    tokenizer = Fast(spec=SPEC, bins=1024, scale=10.0, chunk=8)
    state, padded = TOKENIZER.get_extra_state(), Tokenizer.from_str(TOKENIZER.get_extra_state()["bpe"])
    padded.enable_padding(length=1000)
    tokenizer.load_state_dict(TOKENIZER.state_dict())
    tokenizer.set_extra_state({**state, "bpe": padded.to_str()})
    assert torch.equal(tokenizer.tokenize(CHUNKS), TOKENIZER.tokenize(CHUNKS))
