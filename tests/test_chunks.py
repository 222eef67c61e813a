"""What holds for every model that predicts chunks of continuous actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from fake_batch import MODELS as ALL
from fake_batch import as_policy, make_act, make_batch, make_bc, make_decoder, make_denoising, with_text
from observing import observations

from vla.models.bc import BC
from vla.models.diffusion import Diffusion
from vla.models.flow import Flow
from vla.models.model import Model

MODELS = {name: ALL[name] for name in ("act", "diffusion", "flow")}


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


def test_actions_are_scaled_between_the_bounds_of_the_tokenizer() -> None:
    model = make_act()
    low, high = model.tokenizer.low, model.tokenizer.high
    assert torch.allclose(model.scaled(torch.stack([low, (low + high) / 2, high])).T, torch.tensor([-1.0, 0.0, 1.0]))
    action = torch.rand(5, 3)
    assert torch.allclose(model.unscaled(model.scaled(action)), action, atol=1e-6)


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
    with pytest.raises(ValueError, match=r"model\.execute=5 is more than model\.chunk=4"):
        make_act(chunk=4, execute=5)


def test_without_weight_there_is_no_latent() -> None:
    model = make_act(kl_weight=0.0)
    losses = model.loss(with_text(model, make_batch(1, 4)))
    assert "divergence" not in losses and not hasattr(model, "cvae_encoder")


def test_the_divergence_is_that_of_two_normal_distributions() -> None:
    model = make_act(kl_weight=10.0)
    batch = with_text(model, make_batch(1, 4))
    mean, log_variance = torch.tensor([[1.0, 0.0]] * 4), torch.tensor([[0.0, 0.5]] * 4)
    actions = model.scaled(batch["action"][:, -1])
    losses = model.action_loss({"actions": actions + 0.25, "mean": mean, "log_variance": log_variance}, batch)
    normal = torch.distributions.Normal
    posterior, prior = normal(mean, (log_variance / 2).exp()), normal(0.0, 1.0)
    expected = torch.distributions.kl_divergence(posterior, prior).sum(-1).mean()
    assert torch.isclose(losses["divergence"], expected)
    assert torch.isclose(losses["action_loss"], 0.25 + 10 * expected)


def test_the_latent_is_drawn_in_training_only() -> None:
    model = make_act()
    batch = with_text(model, make_batch(1, 4))
    assert not torch.equal(model(batch)["actions"], model(batch)["actions"])
    assert "mean" not in model.eval()(batch)
    assert torch.equal(model(batch)["actions"], model(batch)["actions"])


def test_the_latent_does_not_know_what_is_not_valid() -> None:
    model = make_act()
    encoder, standing, action = model.cvae_encoder, torch.randn(4, model.context.state_width), torch.randn(4, 4, 3)
    valid = torch.arange(4) < torch.tensor([[1], [2], [4], [0]])
    mean, log_variance = encoder(standing, action, valid)
    other = encoder(standing, action + 3.0 * ~valid.unsqueeze(-1), valid)
    assert torch.allclose(mean, other[0], atol=1e-6) and torch.allclose(log_variance, other[1], atol=1e-6)
    assert not torch.allclose(mean, encoder(standing, action + 3.0, valid)[0], atol=1e-3)
