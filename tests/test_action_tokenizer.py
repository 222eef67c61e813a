"""Actions as tokens: what survives the round trip, what the loss rewards, and what is read."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from defaults import defaults_of
from fake_batch import MOTIONS
from saved_policies import save_policy
from toy import SPEC

from vla.io.errors import UserError
from vla.models.layers import mean_where
from vla.models.policy_folder import read_policy
from vla.models.tokenizers.fast import Fast
from vla.models.tokenizers.quantile import Quantile
from vla.models.tokenizers.tokenizer import (
    ActionTokenizer,
    ComponentTokenizer,
    RT1Bins,
    Uniform,
    out_of_bounds,
    rounding,
)
from vla.spec import ActionStatistics


def between(low: list[float], high: list[float]) -> ActionStatistics:
    """Statistics of actions that are spread evenly between two."""
    return ActionStatistics(np.linspace(low, high, 999, dtype=np.float32), np.array([999]))


BOUNDS = between([-0.02, -0.01, 0.0], [0.03, 0.04, 1.0])


def tokenizers() -> list[ComponentTokenizer]:
    return [
        Uniform(spec=SPEC, statistics=BOUNDS, **defaults_of("tokenizer/uniform")),
        RT1Bins(spec=SPEC, **defaults_of("tokenizer/rt1")),
    ]


@pytest.mark.parametrize("tokenizer", tokenizers(), ids=["uniform", "rt1"])
def test_every_token_survives_the_round_trip_and_the_outermost_are_those_beyond(tokenizer: ComponentTokenizer) -> None:
    tokens = torch.arange(256)[:, None].expand(256, 3)
    assert torch.equal(tokenizer.encode(tokenizer.decode(tokens)), tokens)
    for far, token in ((-9.0, 0), (9.0, 255)):
        assert tokenizer.encode(torch.full((3,), far)).tolist() == [token] * 3


def test_uniform_bounds_are_those_of_the_data_and_a_margin() -> None:
    tokenizer = Uniform(spec=SPEC, statistics=BOUNDS, **defaults_of("tokenizer/uniform", margin=0.1))
    assert tokenizer.low.tolist() == pytest.approx([-0.025, -0.015, -0.1])
    assert tokenizer.high.tolist() == pytest.approx([0.035, 0.045, 1.1])


def test_uniform_rounds_without_bias() -> None:
    tokenizer = Uniform(spec=SPEC, statistics=BOUNDS, **defaults_of("tokenizer/uniform"))
    action = torch.tensor(BOUNDS.low + (BOUNDS.high - BOUNDS.low) * np.random.default_rng(0).random((4000, 3))).float()
    error = tokenizer.decode(tokenizer.encode(action)) - action
    bin_width = (tokenizer.high - tokenizer.low) / 255
    assert (error.abs() <= 0.501 * bin_width).all()
    assert (error.mean(0).abs() < 0.02 * bin_width).all()


def test_a_component_that_never_changes_in_the_data_still_has_bins() -> None:
    constant = between([0.0, 0.01, 1.0], [0.0, 0.01, 1.0])
    tokenizer = Uniform(spec=SPEC, statistics=constant, **defaults_of("tokenizer/uniform"))
    assert (tokenizer.high > tokenizer.low).all()
    action = torch.tensor([0.0, 0.01, 1.0])
    assert torch.allclose(tokenizer.decode(tokenizer.encode(action)), action, atol=1e-3)


def test_rt1_has_fixed_bounds_by_unit_and_rounds_down() -> None:
    tokenizer = RT1Bins(spec=replace(SPEC, units=("m", "rad", "1")), **defaults_of("tokenizer/rt1"))
    assert tokenizer.high.tolist() == pytest.approx([1.0, np.pi / 2, 1.0])
    # 0 lies at 127.5 of 255, a hair below the next bin at 127.9.
    action = torch.tensor([0.0, np.pi / 2 * (2 * 127.9 / 255 - 1), -1.0])
    assert tokenizer.encode(action).tolist() == [127, 127, 0]


def test_what_does_not_fit_the_actions_is_refused() -> None:
    with pytest.raises(UserError, match="rt1 takes actions in m, rad, 1, not in kg"):
        RT1Bins(spec=replace(SPEC, units=("m", "m", "kg")), **defaults_of("tokenizer/rt1"))
    with pytest.raises(UserError, match="2 components, the spec has 3: x, y, gripper"):
        Uniform(spec=SPEC, statistics=between([0.0, 0.0], [1.0, 1.0]), **defaults_of("tokenizer/uniform"))
    for spec in (replace(SPEC, low=(-0.05, 0.05, 0.0)), replace(SPEC, high=(0.05, float("inf"), 1.0))):
        with pytest.raises(UserError, match="the spec must give y finite bounds"):
            Uniform(spec=spec, statistics=BOUNDS, **defaults_of("tokenizer/uniform"))


@pytest.mark.parametrize(
    "tokenizer",
    [*tokenizers(), Uniform(spec=SPEC, **defaults_of("tokenizer/uniform", smoothing=0))],
    ids=["uniform", "rt1", "hard"],
)
def test_minimising_the_loss_makes_the_action_the_one_that_is_read(tokenizer: ComponentTokenizer) -> None:
    action = torch.tensor([[0.0123, -0.0042, 0.9]])
    logits = torch.zeros(1, 3, 256, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.3)
    for _ in range(200):
        optimizer.zero_grad()
        tokenizer.cross_entropy(logits, action).mean().backward()
        optimizer.step()
    bin_width = (tokenizer.high - tokenizer.low) / 255
    assert ((tokenizer.decode_logits(logits) - action).abs() <= 1.001 * bin_width).all()


def test_soft_targets_are_read_finer_than_a_bin_and_two_ways_to_act_are_not_averaged() -> None:
    tokenizer = Uniform(spec=SPEC, statistics=BOUNDS, **defaults_of("tokenizer/uniform"))
    action = torch.tensor([0.0123, -0.0042, 0.9])
    position = (action - tokenizer.low) / (tokenizer.high - tokenizer.low) * 255
    logits = -0.5 * ((torch.arange(256) - position[:, None]) / 3).square()
    bin_width = (tokenizer.high - tokenizer.low) / 255
    assert ((tokenizer.decode_logits(logits) - action).abs() < 0.05 * bin_width).all()
    logits = torch.full((3, 256), -20.0)
    logits[:, 40], logits[:, 200] = 1.0, 0.9
    assert torch.allclose(tokenizer.decode_logits(logits), tokenizer.decode(torch.full((3,), 40.0)), atol=1e-4)


def test_a_mean_is_over_what_is_valid() -> None:
    values, valid = torch.randn(2, 3), torch.tensor([[True, True, False], [False, True, True]])
    assert mean_where(values, valid).item() == pytest.approx(values[valid].mean().item(), rel=1e-5)
    assert mean_where(values, valid) == mean_where(values + ~valid * 0.5, valid)
    assert mean_where(values, torch.zeros_like(valid)) == 0


def test_what_actions_lose_as_tokens_is_a_share_of_their_range() -> None:
    # Bins of 1 m: actions of 0 and 0.25 m in x both become 0 m, which is half of their range, and the gripper loses
    # nothing.
    chunks = np.array([[[0.0, 0.0, 1.0]], [[0.25, 0.0, 0.0]]])
    assert rounding(RT1Bins(bins=3, spec=SPEC), chunks, SPEC) == ("x", pytest.approx(0.5))
    fine = Uniform(spec=SPEC, statistics=BOUNDS, **defaults_of("tokenizer/uniform"))
    assert rounding(fine, BOUNDS.chunks(1), SPEC)[1] < 0.002


CHUNKS = torch.from_numpy(MOTIONS.chunks(8).copy())


KINDS: dict[str, Callable[..., ActionTokenizer]] = {
    "uniform": partial(Uniform, **defaults_of("tokenizer/uniform")),
    "rt1": partial(RT1Bins, **defaults_of("tokenizer/rt1")),
    "quantile": partial(Quantile, **defaults_of("tokenizer/quantile")),
    "fast": partial(Fast, **defaults_of("tokenizer/fast", chunk=8)),
}
EVERY = {name: kind(spec=SPEC, statistics=MOTIONS) for name, kind in KINDS.items()}
every = pytest.mark.parametrize("name", KINDS)


@every
def test_a_chunk_survives_as_a_sequence(name: str) -> None:
    tokenizer = EVERY[name]
    chunks = CHUNKS[:6].view(2, 3, 8, 3)
    tokens = tokenizer.tokenize(chunks)
    assert tokens.shape[:2] == (2, 3) and tokens.dtype == torch.int64
    assert tokens.shape[2] == tokenizer.length(8) or (name == "fast" and tokens.shape[2] < tokenizer.length(8))
    assert tokens.min() >= 0 and tokens.max() < tokenizer.bins
    assert tokenizer.detokenize(tokens).shape == chunks.shape
    assert torch.equal(tokenizer.tokenize(tokenizer.detokenize(tokens)), tokens)


@every
def test_what_the_round_trip_costs_on_small_motions_at_10_hz(name: str) -> None:
    tokenizer = EVERY[name]
    error = tokenizer.detokenize(tokenizer.tokenize(CHUNKS)) - CHUNKS
    mean = 1000 * error[..., :2].abs().mean()  # [mm]
    bias = 1000 * error[..., :2].mean((0, 1)).abs().max()
    least, most, most_bias = {
        "uniform": (0.02, 0.15, 0.02),
        "rt1": (3.0, 5.0, 5.0),  # bins of 8 mm, and always rounded down
        "quantile": (0.01, 0.06, 1e-3),
        "fast": (0.1, 0.6, 0.02),
    }[name]
    assert least < mean < most and bias < most_bias
    assert error[..., :2].abs().max() < 0.009, "no tail is cut off"
    assert error[..., 2].abs().mean() < 0.02


@every
def test_a_policy_brings_all_that_was_fitted(name: str, tmp_path: Path) -> None:
    tokenizer = EVERY[name]
    fresh = KINDS[name](spec=SPEC)
    save_policy(tmp_path, {"task": {}, "tokenizer": {}, "model": {}}, state=tokenizer.state_dict())
    read_policy(tmp_path).restore(fresh)
    tokens = tokenizer.tokenize(CHUNKS[::50])
    assert torch.equal(fresh.tokenize(CHUNKS[::50]), tokens)
    assert torch.equal(fresh.detokenize(tokens), tokenizer.detokenize(tokens))


@every
def test_fitting_twice_gives_the_same_and_so_does_a_copy(name: str) -> None:
    for again in (KINDS[name](spec=SPEC, statistics=MOTIONS), deepcopy(EVERY[name])):
        assert torch.equal(again.tokenize(CHUNKS), EVERY[name].tokenize(CHUNKS))


def test_what_lies_beyond_the_bounds_is_counted() -> None:
    tokenizer = Uniform(spec=SPEC, statistics=BOUNDS, **defaults_of("tokenizer/uniform"))
    chunks = BOUNDS.chunks(1).copy()
    assert out_of_bounds(tokenizer, chunks) == 0
    assert all(out_of_bounds(fitted, CHUNKS.numpy()) == 0 for fitted in EVERY.values())
    chunks[0, 0, :2] = 9.0  # in one action
    assert out_of_bounds(tokenizer, chunks) == pytest.approx(1 / len(chunks))


def test_tokens_are_drawn_from_the_targets() -> None:
    soft, hard = Uniform(spec=SPEC, statistics=MOTIONS, **defaults_of("tokenizer/uniform")), EVERY["quantile"]
    tokens = soft.tokenize(CHUNKS)
    off = (soft.sample_inputs(tokens, CHUNKS) - tokens)[:, :2].double()
    assert off.std().item() == pytest.approx(3.0, rel=0.1) and abs(off.mean().item()) < 0.2
    assert torch.equal(hard.sample_inputs(tokens, CHUNKS), tokens)


def test_quantile_bins_hold_as_many_actions_each_and_are_read_as_their_mean() -> None:
    tokenizer = Quantile(bins=64, spec=SPEC, statistics=MOTIONS)
    tokens = tokenizer.encode(torch.from_numpy(MOTIONS.actions))
    counts = tokens[:, 1].bincount(minlength=64)
    assert counts.min() >= 4000 // 64 - 1 and counts.max() <= 4000 // 64 + 2
    for token in range(64):
        inside = MOTIONS.actions[(tokens[:, 0] == token).numpy(), 0]
        assert tokenizer.decode(torch.tensor([token] * 3))[0] == pytest.approx(inside.mean(), abs=1e-7)


def test_values_that_occur_often_are_one_bin_each() -> None:
    actions = np.array([[-0.05, 0.01, 0.0]] * 50 + [[0.02, 0.01, 1.0]] * 30 + [[0.05, 0.01, 1.0]] * 20, np.float32)
    tokenizer = Quantile(bins=32, spec=SPEC, statistics=ActionStatistics(actions, np.array([len(actions)])))
    tokens = tokenizer.encode(torch.from_numpy(actions))
    assert [len(column.unique()) for column in tokens.T] == [3, 1, 2]
    assert torch.allclose(tokenizer.decode(tokens), torch.from_numpy(actions), atol=1e-7)
    near = tokenizer.encode(torch.tensor([[0.02 - 1e-4, 0.01, 1.0 - 1e-5]]))  # what rounding does changes nothing
    assert torch.equal(near[0], tokens[60])
