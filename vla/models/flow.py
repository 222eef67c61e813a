"""Flow matching: noise moves to a chunk of actions along a field of velocities that a network has learned.

Along straight paths, as in rectified flow (X. Liu, C. Gong, Q. Liu, arXiv 2209.03003), with the times of K. Black et
al., "π0: A Vision-Language-Action Flow Model for General Robot Control", arXiv 2410.24164.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token.
"""

from __future__ import annotations

from torch import Tensor

from vla.models.denoiser import DenoisingModel

LATEST = 0.999  # time up to which velocities are learned
SHAPE = 1.5  # of the beta distribution of times, the other being 1


class Flow(DenoisingModel):
    """Predicts the velocity from noise, at time 0, to actions, at time 1; acts by Euler steps of equal length.

    Training times are those of π0, 0.999 (1 - Beta(1.5, 1)), early ones more often: there the scene must say what to
    do, while later the noisy actions themselves say most of it.
    """

    def corrupt(self, action: Tensor, noise: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points on the way from noise to actions; the target is the velocity, the same all along it."""
        time = LATEST * (1 - uniform ** (1 / SHAPE))  # a power of a uniform number is distributed as Beta(1.5, 1)
        part = time[:, None, None]
        return part * action + (1 - part) * noise, time, action - noise

    def sample(self, noise: Tensor, context: Tensor) -> Tensor:
        """The place at time 1 of what is at `noise` at time 0."""
        x = noise
        for step in range(self.steps):
            x = x + self.denoiser(x, x.new_full((len(x),), step / self.steps), context) / self.steps
        return x
