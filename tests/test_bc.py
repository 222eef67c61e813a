"""The behaviour-cloning model, and what holds for every model."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from fake_batch import make_act, make_batch, make_bc, make_decoder, make_rt1, overfit, with_text
from toy import SPEC

from vla.models.layers import RunningNormalizer
from vla.models.model import Model
from vla.models.tokenizers.tokenizer import Uniform

MODELS: dict[str, Callable[..., Model]] = {
    "bc": make_bc,
    "bc chunk": partial(make_bc, chunk=3),
    "rt1": make_rt1,
    "rt1 chunk": partial(make_rt1, chunk=2, proprioception=True),
}
every_model = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())


@every_model
def test_shapes(make: Callable[[], Model]) -> None:
    model = make()
    batch = with_text(model, make_batch(model.history, model.chunk))
    output = model(batch)
    assert output["logits"].shape == (4, model.history, model.chunk, 3, 64)
    assert output["truth"].shape == (4, model.history, SPEC.truth_size)
    assert model.loss(batch)["loss"].shape == ()


@pytest.mark.parametrize("name", ["bc chunk", "rt1 chunk"])
def test_overfits_one_batch(name: str) -> None:
    torch.manual_seed(0)
    model = MODELS[name]()
    assert overfit(model, with_text(model, make_batch(model.history, model.chunk))) < 0.02


@every_model
def test_saves_and_loads_equal(make: Callable[[], Model]) -> None:
    torch.manual_seed(0)
    model, other = make(), make()
    batch = with_text(model, make_batch(model.history, model.chunk))
    model.loss(batch)  # gathers statistics, which must travel too
    other.load_state_dict(model.state_dict())
    assert torch.equal(model.eval()(batch)["logits"], other.eval()(batch)["logits"])


@every_model
def test_predictions_ignore_truth_and_labels(make: Callable[[], Model]) -> None:
    model = make().eval()
    batch = with_text(model, make_batch(model.history, model.chunk))
    seen = {name: value for name, value in batch.items() if name not in ("truth", "action", "valid", "instruction")}
    assert torch.equal(model(batch)["logits"], model(seen)["logits"])


@every_model
def test_the_instruction_matters(make: Callable[[], Model]) -> None:
    model = make().eval()
    batch = with_text(model, make_batch(model.history, model.chunk))
    other = {**batch, "text": model.text.tokenize(["push the button"] * 4)}
    assert not torch.allclose(model(batch)["logits"], model(other)["logits"])


@pytest.mark.parametrize("make", [*MODELS.values(), partial(make_decoder, chunk=2)], ids=[*MODELS, "decoder"])
def test_log_probabilities_of_actions_are_those_of_the_cross_entropy(make: Callable[..., Model]) -> None:
    """With targets of one bin; and each of a decoder is given those before it, as in its training."""
    model = make(auxiliary=0.0).eval()
    model.tokenizer = Uniform(64, 0.05, 0.0, 0, spec=SPEC)
    batch = with_text(model, make_batch(model.history, model.chunk))
    batch["valid"][:, :-1] = False
    found = model.log_probabilities(batch, batch["action"][:, -1])
    assert found.shape == (4, model.chunk) and (found < 0).all()
    assert -found.mean().item() / 3 == pytest.approx(model.loss(batch)["action_loss"].item(), rel=1e-5)


def test_numbers_have_no_log_probabilities() -> None:
    model = make_act()
    batch = with_text(model, make_batch(1, 4))
    with pytest.raises(ValueError, match="ACT with Uniform gives actions no probabilities"):
        model.log_probabilities(batch, batch["action"][:, -1])


def test_without_weight_there_is_no_auxiliary_head() -> None:
    model = make_bc(auxiliary=0.0)
    losses = model.loss(with_text(model, make_batch(1)))
    assert set(losses) == {"loss", "action_loss"}
    assert losses["loss"] == losses["action_loss"]


def test_padding_does_not_count_in_the_auxiliary_loss() -> None:
    model = make_rt1().eval()
    batch = with_text(model, make_batch(3))
    batch["present"][:, 0] = False
    other = {**batch, "truth": batch["truth"].clone()}
    other["truth"][:, 0] = 99.0
    assert model.loss(batch)["truth_loss"] == model.loss(other)["truth_loss"]


def test_frames_of_unknown_truth_do_not_count_in_the_auxiliary_loss() -> None:
    model = make_rt1().eval()
    batch = with_text(model, make_batch(3))
    unknown = {**batch, "truth": batch["truth"].clone()}
    unknown["truth"][:2] = torch.nan
    losses = model.loss(unknown)
    standard = model.truth_scale(batch["truth"], batch["present"])
    error = (model(batch)["truth"].float() - standard).square().mean(-1)
    torch.testing.assert_close(losses["truth_loss"], error[2:].mean())
    assert torch.isfinite(losses["loss"])


def test_running_normalizer_accumulates_statistics_of_present_frames() -> None:
    torch.manual_seed(0)
    normalizer = RunningNormalizer(3)
    values = torch.randn(50, 2, 3) * torch.tensor([0.1, 2.0, 0.0]) + torch.tensor([1.0, -3.0, 7.0])
    present = torch.rand(50, 2) > 0.3
    for part, there in zip(values.split(7), present.split(7), strict=True):
        normalizer(part, there)
    assert torch.allclose(normalizer.mean, values[present].mean(0), atol=1e-5)
    assert torch.allclose(normalizer.std[:2], values[present].std(0, correction=0)[:2], rtol=1e-4)
    standard = normalizer.eval()(values, present)
    assert (standard[~present] == 0).all() and torch.isfinite(standard).all()
    assert torch.allclose((standard * normalizer.std + normalizer.mean)[present], values[present], atol=1e-4)


def test_running_normalizer_does_not_update_outside_training() -> None:
    normalizer = RunningNormalizer(2).eval()
    normalizer(torch.ones(1, 1, 2), torch.ones(1, 1, dtype=torch.bool))
    assert normalizer.count == 0
