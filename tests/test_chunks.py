"""What holds for every model that predicts chunks of continuous actions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from fake_batch import (
    as_policy,
    make_act,
    make_batch,
    make_bc,
    make_decoder,
    make_denoising,
    overfit,
    with_text,
)
from observing import observations
from toy import SPEC, ToyEnvironment

from vla.models.bc import BC
from vla.models.diffusion import Diffusion
from vla.models.flow import Flow
from vla.models.model import ContextModel, Model
from vla.rollouts.rollout import rollout

MODELS: dict[str, Callable[..., ContextModel]] = {
    "act": make_act,
    "diffusion": partial(make_denoising, Diffusion),
    "flow": partial(make_denoising, Flow),
}
every_model = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())


def batch_for(model: ContextModel) -> dict[str, Any]:
    return with_text(model, make_batch(1, model.chunk))


@every_model
def test_shapes(make: Callable[..., ContextModel]) -> None:
    model = make()
    batch = batch_for(model)
    assert model(batch)["truth"].shape == (4, 1, SPEC.truth_size)
    assert model.loss(batch)["loss"].shape == ()
    prediction = model.eval().predict(batch)
    assert prediction.actions.shape == (4, 4, 3) and prediction.actions.dtype == torch.float32
    assert prediction.probabilities is None


@every_model
def test_overfits_one_batch(make: Callable[..., ContextModel]) -> None:
    torch.manual_seed(0)
    model = make(chunk=2)
    assert overfit(model, batch_for(model), steps=200) < 0.08


@every_model
def test_saves_and_loads_equal(make: Callable[..., ContextModel]) -> None:
    torch.manual_seed(0)
    model, other = make(), make()
    batch = batch_for(model)
    model.loss(batch)  # gathers statistics, which must travel too
    other.load_state_dict(model.state_dict())
    assert torch.equal(model.eval().predict(batch).actions, other.eval().predict(batch).actions)


@every_model
def test_predictions_ignore_truth_and_labels(make: Callable[..., ContextModel]) -> None:
    model = make().eval()
    batch = batch_for(model)
    seen = {name: value for name, value in batch.items() if name not in ("truth", "action", "valid", "instruction")}
    assert torch.equal(model.predict(batch).actions, model.predict(seen).actions)


@every_model
def test_the_instruction_matters(make: Callable[..., ContextModel]) -> None:
    model = make().eval()
    batch = batch_for(model)
    other = {**batch, "text": model.text.tokenize(["push the button"] * 4)}
    assert not torch.allclose(model.predict(batch).actions, model.predict(other).actions)


@every_model
def test_without_weight_there_is_no_auxiliary_head(make: Callable[..., ContextModel]) -> None:
    model = make(auxiliary=0.0)
    losses = model.loss(batch_for(model))
    assert losses["loss"] == losses["action_loss"] and "truth_loss" not in losses


@pytest.mark.parametrize("make", [make_bc, *MODELS.values()], ids=["bc", *MODELS])
def test_without_proprioception_the_robot_state_does_not_matter(make: Callable[..., Model]) -> None:
    seeing = make()
    batch = with_text(seeing, make_batch(1, seeing.chunk))
    other = {**batch, "state": batch["state"].flip(0)}
    seeing.loss(batch)  # gathers statistics
    assert not torch.allclose(seeing.eval().predict(batch).actions, seeing.predict(other).actions)
    model = make(proprioception=False)
    assert model.loss(batch)["loss"].isfinite()
    assert torch.equal(model.eval().predict(batch).actions, model.predict(other).actions)
    assert not any("state" in name or "proprioception" in name for name in model.state_dict())


@every_model
def test_labels_that_are_not_valid_count_for_nothing(make: Callable[..., ContextModel]) -> None:
    model = make()
    batch = batch_for(model)
    batch["valid"][:, :, 2:] = False
    batch["valid"][0] = False
    other = {**batch, "action": batch["action"].clone()}
    other["action"][~batch["valid"]] = 7.0
    losses = []
    for labels in (batch, other):
        torch.manual_seed(0)
        losses.append(model.loss(labels)["loss"])
    assert torch.isfinite(losses[0]) and losses[0].item() == pytest.approx(losses[1].item(), rel=1e-6)


@every_model
def test_actions_are_scaled_between_the_bounds_of_the_tokenizer(make: Callable[..., ContextModel]) -> None:
    model = make()
    low, high = model.tokenizer.low, model.tokenizer.high
    assert torch.allclose(model.scaled(torch.stack([low, (low + high) / 2, high])).T, torch.tensor([-1.0, 0.0, 1.0]))
    action = torch.rand(5, 3)
    assert torch.allclose(model.unscaled(model.scaled(action)), action, atol=1e-6)


@every_model
def test_validation_leaves_the_random_numbers_of_training_alone(make: Callable[..., ContextModel]) -> None:
    model = make().eval()
    batch = batch_for(model)
    before = torch.get_rng_state()
    first, second = model.loss(batch)["loss"], model.loss(batch)["loss"]
    model.predict(batch)
    assert torch.equal(torch.get_rng_state(), before) and first == second


@every_model
def test_plays_an_episode_that_follows_from_the_seed(make: Callable[..., ContextModel]) -> None:
    policy = as_policy(make())
    first, other, again = (rollout(ToyEnvironment(), policy, seed).actions for seed in (3, 8, 3))
    assert first.shape == (40, 3) and first.dtype == np.float32
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize("make", [*MODELS.values(), make_bc], ids=[*MODELS, "bc"])
def test_looks_again_after_the_actions_that_are_executed(make: Callable[..., Model]) -> None:
    model = make(chunk=4, execute=2)
    policy = as_policy(model)
    looks: list[int] = []
    acted: list[np.ndarray] = []
    encoder: Any = model.get_submodule("features.images.0" if isinstance(model, BC) else "context.features.images.0")
    encoder.register_forward_pre_hook(lambda module, inputs: looks.append(len(acted)))
    seen = observations(6)
    policy.reset(seen[0].instruction, 0)
    for observation in seen:
        acted.append(policy.act(observation))
    assert looks == [0, 2, 4]
    policy.reset(seen[0].instruction, 0)
    plan = policy.plan(seen[0])
    assert plan.shape == (4, 3) and np.array_equal(plan[:2], acted[:2])


@pytest.mark.parametrize("make", [*MODELS.values(), make_decoder], ids=[*MODELS, "decoder"])
def test_a_width_that_heads_cannot_share_is_refused(make: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=r"model\.width=32 must be a multiple of model\.heads=5"):
        make(heads=5)


@pytest.mark.parametrize("kind", [Diffusion, Flow])
def test_a_width_without_room_for_pairs_is_refused(kind: type[Any]) -> None:
    with pytest.raises(ValueError, match=r"model\.width=33 must be even"):
        make_denoising(kind, width=33, heads=3)


def test_more_cannot_be_executed_than_is_predicted() -> None:
    with pytest.raises(ValueError, match=r"model\.execute=5 is more than the model\.chunk=4"):
        make_act(chunk=4, execute=5)


@every_model
def test_images_that_it_does_not_look_at_make_no_difference(make: Callable[..., ContextModel]) -> None:
    policy = as_policy(make(chunk=4, execute=2))
    everything, sparse = (rollout(ToyEnvironment(), policy, 3, all_images=every) for every in (True, False))
    assert np.array_equal(everything.executed, sparse.executed) and len(sparse.executed) == 40
    assert [bool(observation.rgb) for observation in sparse.observations] == [True, False] * 20
    assert all(observation.rgb for observation in everything.observations)
