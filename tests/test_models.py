"""What holds for every model."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from fake_batch import MODELS as ALL
from fake_batch import make_bc, make_rt1, overfit, with_motions
from test_decoder import MODELS as DECODERS
from toy import SPEC

from vla.models.layers import RunningNormalizer
from vla.models.model import Model
from vla.models.vlm.prompt import Prompt

MODELS: dict[str, Callable[..., Model]] = {
    **ALL,
    "bc chunk": partial(make_bc, chunk=3),
    "rt1 chunk": partial(make_rt1, chunk=2, proprioception=True),
    **{f"decoder {name}": make for name, make in DECODERS.items() if name != "uniform"},
}
NUMBERS = ("act", "diffusion", "flow")  # those that predict numbers instead of tokens
every_model = pytest.mark.parametrize("name", MODELS)


def made(name: str, **options: Any) -> tuple[Any, dict[str, Any]]:
    """The same model every time, and a batch of noise with motions as labels."""
    torch.manual_seed(0)
    model = MODELS[name](**options)
    return model, with_motions(model)


def test_an_infinite_truth_leaves_the_statistics_alone() -> None:
    model, batch = made("rt1")
    batch["truth"][0] = torch.inf
    assert model.loss(batch)["loss"].isfinite() and model.truth_scale.variance.isfinite().all()


@every_model
def test_shapes(name: str) -> None:
    model, batch = made(name)
    frames = model.history if name.startswith("rt1") else 1
    assert model(batch)["truth"].shape == (4, frames, SPEC.truth_size)
    assert model.loss(batch)["loss"].shape == ()
    prediction = model.eval().predict(batch)
    assert prediction.actions.shape == (4, model.chunk, 3) and prediction.actions.dtype == torch.float32
    if name in (*NUMBERS, "decoder fast"):
        assert prediction.probabilities is None
    else:
        assert prediction.probabilities.shape == (4, model.chunk, 3, model.tokenizer.bins)
        assert torch.allclose(prediction.probabilities.sum(-1), torch.ones(4, model.chunk, 3), atol=1e-4)


@pytest.mark.parametrize("name", ["bc chunk", "rt1 chunk", "decoder quantile", "decoder fast"])
def test_overfits_one_batch(name: str) -> None:
    """Those of `NUMBERS`: test_context."""
    model, batch = made(name)
    assert overfit(model, batch, steps=100) < 0.02


@every_model
def test_saves_and_loads_equal_and_ignores_truth_and_labels(name: str) -> None:
    model, batch = made(name)
    other = MODELS[name]()  # with other weights
    model.loss(batch)  # gathers statistics, which must travel too
    other.load_state_dict(model.state_dict())
    seen = {name: value for name, value in batch.items() if name not in ("truth", "action", "valid", "instruction")}
    assert torch.equal(model.eval().predict(batch).actions, other.eval().predict(seen).actions)


@every_model
def test_the_instruction_matters(name: str) -> None:
    model, batch = made(name)
    output = "context" if name in ("diffusion", "flow") else "actions" if name == "act" else "logits"
    other = {**batch, "text": model.text.tokenize(["push the button"] * 4)}
    assert not torch.allclose(model.eval()(batch)[output], model(other)[output])


@every_model
def test_labels_that_are_not_valid_count_for_nothing(name: str) -> None:
    model, batch = made(name)
    model.auxiliary = 0.0
    batch["valid"][:, :, 1:], batch["valid"][0] = False, False
    batch["perturbations"][~batch["valid"]] = -1
    other = {**batch, "action": batch["action"].clone()}
    changed = ~batch["valid"]
    if name == "decoder fast":  # whose tokens are of whole chunks
        changed[1:] = False
    other["action"][changed] = 0.01
    losses = []
    for labels in (batch, other):
        torch.manual_seed(0)
        losses.append(model.loss(labels)["action_loss"])
    assert torch.isfinite(losses[0]) and losses[0].item() == pytest.approx(losses[1].item(), rel=1e-5)


@every_model
def test_validation_leaves_the_random_numbers_of_training_alone(name: str) -> None:
    model, batch = made(name)
    model.eval()
    before = torch.get_rng_state()
    first, second = model.loss(batch)["loss"], model.loss(batch)["loss"]
    model.predict(batch)
    assert torch.equal(torch.get_rng_state(), before) and first == second


def test_a_text_encoder_that_makes_tokens_is_refused_where_a_vector_is_needed() -> None:
    with pytest.raises(ValueError, match=r"needs a vector of the sentence, and Prompt makes .* model/text=ngrams"):
        make_bc(text=partial(Prompt, None, 20, False))


@pytest.mark.parametrize("name", ["bc", "rt1", "decoder", *NUMBERS])
def test_without_weight_there_is_no_auxiliary_head(name: str) -> None:
    model, batch = made(name, auxiliary=0.0)
    losses = model.loss(batch)
    assert losses["loss"] == losses["action_loss"] and "truth_loss" not in losses


def test_frames_that_are_padding_or_of_unknown_truth_do_not_count_in_the_auxiliary_loss() -> None:
    model, batch = made("rt1")
    model.eval()
    batch["present"][:, 0] = False
    unknown = {**batch, "truth": batch["truth"].clone()}
    unknown["truth"][:, 0], unknown["truth"][:2] = 99.0, torch.nan
    losses = model.loss(unknown)
    standard = model.truth_scale(batch["truth"], batch["present"])
    error = (model(batch)["truth"].float() - standard).square().mean(-1)
    torch.testing.assert_close(losses["truth_loss"], error[2:, 1:].mean())
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
    normalizer(torch.ones(1, 1, 3), torch.ones(1, 1, dtype=torch.bool))
    assert normalizer.count == present.sum()  # outside training nothing is added
