"""Diffusion policy: iterative denoising of an action chunk.

C. Chi et al., "Diffusion Policy: Visuomotor Policy Learning via Action Diffusion", arXiv 2303.04137; DDIM: J. Song, C.
Meng, S. Ermon, arXiv 2010.02502; the schedule: A. Nichol, P. Dhariwal, arXiv 2102.09672.

Shapes: B batch, k action chunk, D action components.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from vla.models.denoiser import Denoise, DenoisingModel

LEVELS = 100  # noise levels of training
START = 90  # first level of sampling: 2 % of the variance is signal; higher levels carry no information
OFFSET = 0.008  # of the cosine schedule, for some noise at level 0
MIN_ALPHA_BAR = 2.5e-7  # about as if no step removed more than 0.999 of the variance


class Diffusion(DenoisingModel):
    """Noise prediction on action chunks, sampled by deterministic DDIM with clipped estimates."""

    def corrupt(self, action: Tensor, noise: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Add noise at a uniformly distributed level; the target is the noise."""
        level = (uniform * LEVELS).floor().clamp(max=LEVELS - 1)  # (B,)
        signal = alpha_bar(level)[:, None, None]
        return signal.sqrt() * action + (1 - signal).sqrt() * noise, level / LEVELS, noise

    def sample(self, noise: Tensor, denoise: Denoise) -> Tensor:
        """Run DDIM with eta = 0 over evenly spaced levels from START to 0."""
        levels = torch.linspace(START, 0, self.steps, device=noise.device).round()
        signals = [*alpha_bar(levels), torch.ones((), device=noise.device)]
        x = noise
        for level, signal, next_signal in zip(levels, signals[:-1], signals[1:], strict=True):
            noise = denoise(x, (level / LEVELS).expand(len(x))).float()
            action = ((x - (1 - signal).sqrt() * noise) / signal.sqrt()).clamp(-1, 1)
            noise = (x - signal.sqrt() * action) / (1 - signal).sqrt()  # consistent with the clipped estimate
            x = next_signal.sqrt() * action + (1 - next_signal).sqrt() * noise
        return x


def alpha_bar(level: Tensor) -> Tensor:
    """Return the signal share of the variance at noise levels 0 … LEVELS - 1, by the squared cosine schedule."""
    angle = ((level + 1) / LEVELS + OFFSET) / (1 + OFFSET) * math.pi / 2
    start = OFFSET / (1 + OFFSET) * math.pi / 2
    return (angle.cos() / math.cos(start)).square().clamp(min=MIN_ALPHA_BAR)
