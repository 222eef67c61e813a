"""Bins that hold as many actions of the data each."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fake_batch import Motions
from toy import SPEC

from vla.models.tokenizers.quantile import Quantile

MOTIONS = Motions()


def test_quantile_bins_hold_as_many_actions_each() -> None:
    tokenizer = Quantile(bins=64, spec=SPEC, statistics=MOTIONS)
    tokens = tokenizer.encode(torch.from_numpy(MOTIONS.actions))
    counts = tokens[:, 1].bincount(minlength=64)
    assert counts.min() >= 4000 // 64 - 1 and counts.max() <= 4000 // 64 + 2


def test_quantile_reads_a_bin_as_the_mean_of_its_data() -> None:
    tokenizer = Quantile(bins=16, spec=SPEC, statistics=MOTIONS)
    tokens = tokenizer.encode(torch.from_numpy(MOTIONS.actions))
    for token in range(16):
        inside = MOTIONS.actions[(tokens[:, 0] == token).numpy(), 0]
        assert tokenizer.decode(torch.tensor([token] * 3))[0] == pytest.approx(inside.mean(), abs=1e-7)


def test_values_that_occur_often_are_one_bin_each() -> None:
    actions = np.array([[-0.05, 0.01, 0.0]] * 50 + [[0.02, 0.01, 1.0]] * 30 + [[0.05, 0.01, 1.0]] * 20, np.float32)
    statistics = Motions()
    statistics.actions, statistics.low, statistics.high = actions, actions.min(0), actions.max(0)
    tokenizer = Quantile(bins=32, spec=SPEC, statistics=statistics)
    tokens = tokenizer.encode(torch.from_numpy(actions))
    assert [len(column.unique()) for column in tokens.T] == [3, 1, 2]
    assert torch.allclose(tokenizer.decode(tokens), torch.from_numpy(actions), atol=1e-7)
    near = tokenizer.encode(torch.tensor([[0.02 - 1e-4, 0.01, 1.0 - 1e-5]]))  # what rounding does changes nothing
    assert torch.equal(near[0], tokens[60])
