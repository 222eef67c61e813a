"""The denoiser, and the paths on which diffusion and flow matching go from noise to actions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from fake_batch import as_policy, make_batch, make_denoising, with_text
from observing import observations
from torch import Tensor

from vla.deploy.inference import Inference
from vla.models.denoiser import Denoiser, DenoisingModel
from vla.models.diffusion import LEVELS, Diffusion, alpha_bar
from vla.models.flow import Flow


def test_an_action_sees_those_before_it_only() -> None:
    denoiser = Denoiser(components=3, chunk=5, width=16, layers=2, heads=2)
    noisy, time, context = torch.randn(2, 5, 3), torch.rand(2), torch.randn(2, 4, 16)
    changed = noisy.clone()
    changed[:, 3:] += 1
    before, after = denoiser(noisy, time, context), denoiser(changed, time, context)
    assert torch.allclose(before[:, :3], after[:, :3], atol=1e-6)
    assert not torch.allclose(before[:, 3:], after[:, 3:], atol=1e-3)


def test_the_denoiser_knows_time_and_scene() -> None:
    denoiser = Denoiser(components=3, chunk=5, width=16, layers=2, heads=2)
    noisy, time, context = torch.randn(2, 5, 3), torch.rand(2), torch.randn(2, 4, 16)
    before = denoiser(noisy, time, context)
    assert not torch.allclose(before, denoiser(noisy, time / 2, context), atol=1e-4)
    assert not torch.allclose(before, denoiser(noisy, time, context + 1), atol=1e-4)


def test_the_schedule_is_what_its_steps_multiply_to() -> None:
    def ideal(part: float) -> float:
        return math.cos((part + 0.008) / 1.008 * math.pi / 2) ** 2

    taken = [min(1 - ideal((step + 1) / LEVELS) / ideal(step / LEVELS), 0.999) for step in range(LEVELS)]
    expected = (1 - torch.tensor(taken)).cumprod(0)
    assert torch.allclose(alpha_bar(torch.arange(LEVELS)), expected, rtol=1e-3, atol=1e-8)


def test_a_level_of_noise_keeps_its_share_of_the_variance() -> None:
    model = make_denoising(Diffusion)
    action, noise = torch.full((3, 4, 3), 0.5), torch.full((3, 4, 3), -2.0)
    noisy, time, target = model.corrupt(action, noise, torch.tensor([0.0, 0.505, 1.0]))
    assert time.tolist() == pytest.approx([0.0, 0.5, 0.99]) and torch.equal(target, noise)
    for row, level in zip(noisy, (0, 50, 99), strict=True):
        share = alpha_bar(torch.tensor(level)).item()
        assert torch.allclose(row, torch.tensor(math.sqrt(share) * 0.5 - math.sqrt(1 - share) * 2))


@pytest.mark.parametrize("steps", [1, 3, 10])
def test_ddim_with_the_true_noise_recovers_the_actions(steps: int) -> None:
    model = make_denoising(Diffusion)
    model.steps = steps
    action = 2 * torch.rand(2, 4, 3) - 1

    def noise_in(noisy: Tensor, time: Tensor) -> Tensor:
        share = alpha_bar((time * LEVELS).round())[:, None, None]
        return (noisy - share.sqrt() * action) / (1 - share).sqrt()

    assert torch.allclose(model.sample(torch.randn(2, 4, 3), noise_in), action, atol=1e-4)


@pytest.mark.parametrize("steps", [1, 2, 5, 10])
def test_samples_of_the_ideal_denoiser_do_not_exceed_the_prior_spread(steps: int) -> None:
    model = make_denoising(Diffusion)
    model.steps, spread = steps, 0.2

    def expected(noisy: Tensor, time: Tensor) -> Tensor:
        """The mean of the noise in what was made of normal actions around 0."""
        share = alpha_bar((time * LEVELS).round())[:, None, None]
        return (1 - share).sqrt() * noisy / (share * spread**2 + 1 - share)

    actions = model.sample(torch.randn(500, 4, 3, generator=torch.Generator().manual_seed(0)), expected)
    assert actions.std() < 1.1 * spread


def test_a_constant_velocity_leads_exactly_there() -> None:
    model = make_denoising(Flow)
    noise, velocity = torch.randn(2, 4, 3), torch.randn(2, 4, 3)
    assert torch.allclose(model.sample(noise, lambda noisy, time: velocity), noise + velocity, atol=1e-5)


def test_flow_leads_straight_from_noise_to_actions() -> None:
    model = make_denoising(Flow)
    action, noise = torch.rand(3, 4, 3), torch.randn(3, 4, 3)
    noisy, time, velocity = model.corrupt(action, noise, torch.tensor([0.0, 0.5, 1.0]))
    assert time.tolist() == pytest.approx([0.999, 0.999 * (1 - 0.5 ** (2 / 3)), 0.0])
    assert torch.allclose(noisy + (1 - time[:, None, None]) * velocity, action, atol=1e-5)
    assert torch.equal(noisy[2], noise[2])


@pytest.mark.parametrize("kind", [Diffusion, Flow])
def test_what_is_done_follows_from_the_noise(kind: type[DenoisingModel]) -> None:
    model = make_denoising(kind).eval()
    batch = with_text(model, make_batch(1, 4))
    one, other = torch.randn(4, 4, 3), torch.randn(4, 4, 3)
    with_one = model.predict({**batch, "noise": one}).actions
    assert torch.equal(with_one, model.predict({**batch, "noise": one}).actions)
    assert not torch.allclose(with_one, model.predict({**batch, "noise": other}).actions)
    model.temperature = 0.0
    middle = model.predict({**batch, "noise": one}).actions
    assert torch.equal(middle, model.predict({**batch, "noise": other}).actions)


def test_on_a_robot_the_noise_differs_between_episodes_and_repeats() -> None:
    model, (seen, *_) = make_denoising(Flow, temperature=1.0).eval(), observations(1)
    runs = []
    for warm in (True, False):
        inference, plans = Inference(as_policy(model)), []
        if warm:
            inference.warm_up()
        for _ in range(2):
            inference.start(seen, is_first=True)
            while (taken := inference.take()) is None:
                pass
            plans.append(taken[0])
        inference.close()
        assert not np.array_equal(plans[0], plans[1])
        runs.append(plans)
    assert np.array_equal(runs[0], runs[1])
