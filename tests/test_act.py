"""ACT: the latent, and what it is worth."""

from __future__ import annotations

import torch
from fake_batch import make_act, make_batch, with_text


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
