"""Diffusion policy: noise becomes a chunk of actions by taking away, step by step, what a network takes for noise.

C. Chi et al., "Diffusion Policy: Visuomotor Policy Learning via Action Diffusion", arXiv 2303.04137; DDIM: J. Song, C.
Meng, S. Ermon, arXiv 2010.02502; the schedule: A. Nichol, P. Dhariwal, arXiv 2102.09672.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from vla.models.denoiser import DenoisingModel

LEVELS = 100  # of noise
START = 90  # level to act from: noise but for 2 % of its variance; further up nothing is told of the action
OFFSET = 0.008  # of the schedule, so that there is some noise from the start
LEAST = 2.5e-7  # share kept at the last level, as where no step may take away more than 0.999 of the variance


class Diffusion(DenoisingModel):
    """Predicts the noise in chunks of actions; acts by DDIM without fresh noise, with every estimate clipped."""

    def corrupt(self, action: Tensor, noise: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Actions at a level of noise, each as likely as any other; the target is the noise."""
        level = (uniform * LEVELS).floor().clamp(max=LEVELS - 1)  # (B,)
        share = kept(level)[:, None, None]
        return share.sqrt() * action + (1 - share).sqrt() * noise, level / LEVELS, noise

    def sample(self, noise: Tensor, context: Tensor) -> Tensor:
        """DDIM with eta = 0 over evenly spread levels, from START to, where there is more than one, 0."""
        levels = torch.linspace(START, 0, self.steps, device=noise.device).round()
        shares = [*kept(levels), torch.ones((), device=noise.device)]
        x = noise
        for level, share, following in zip(levels, shares[:-1], shares[1:], strict=True):
            found = self.denoiser(x, (level / LEVELS).expand(len(x)), context).float()
            action = ((x - (1 - share).sqrt() * found) / share.sqrt()).clamp(-1, 1)
            found = (x - share.sqrt() * action) / (1 - share).sqrt()  # what is left beside the clipped estimate
            x = following.sqrt() * action + (1 - following).sqrt() * found
        return x


def kept(level: Tensor) -> Tensor:
    """Share of the variance of the actions that is kept at levels 0 … LEVELS - 1 of noise: a squared cosine."""
    angle = ((level + 1) / LEVELS + OFFSET) / (1 + OFFSET) * math.pi / 2
    start = OFFSET / (1 + OFFSET) * math.pi / 2
    return (angle.cos() / math.cos(start)).square().clamp(min=LEAST)
