"""Flow matching: noise is transported to an action chunk along a learned velocity field.

The paths are straight, as in rectified flow (X. Liu, C. Gong, Q. Liu, arXiv 2209.03003), with the time distribution of
K. Black et al., "π0: A Vision-Language-Action Flow Model for General Robot Control", arXiv 2410.24164.

Shapes: B batch, k action chunk, D action components.
"""

from __future__ import annotations

from torch import Tensor

from vla.io.types import Inherited, Natural
from vla.models.chunking import require_prefix
from vla.models.denoiser import Denoise, DenoisingModel

MAX_TIME = 0.999  # of training
SHAPE = 1.5  # first parameter of the beta distribution of times; the second is 1


class Flow(DenoisingModel):
    """Velocity prediction from noise, at time 0, to actions, at time 1, sampled by Euler steps of equal length.

    Training times follow π0, 0.999 (1 - Beta(1.5, 1)). Early times are more frequent: there the prediction depends on
    the context, later mostly on the noisy actions themselves.

    Args:
        prefix: largest number of executed actions that training gives, without noise (time 1), at the start of a chunk
            to predict the rest; for `vla.models.chunking.TrainedPrefix`.

    Raises:
        UserError: `prefix` leaves fewer than `execute` actions of a chunk.
    """

    continues = True

    def __init__(self, prefix: Natural, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.prefix = prefix
        require_prefix(prefix, self.execute, self.chunk)

    def corrupt(self, action: Tensor, noise: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Interpolate between noise and actions; the target is the constant velocity of that path."""
        time = MAX_TIME * (1 - uniform ** (1 / SHAPE))  # uniform ** (2 / 3) ~ Beta(1.5, 1)
        part = time[:, None, None]
        return part * action + (1 - part) * noise, time, action - noise

    def sample(self, noise: Tensor, denoise: Denoise) -> Tensor:
        """Integrate the velocity from `noise` at time 0 to time 1."""
        x = noise
        for step in range(self.steps):
            x = x + denoise(x, x.new_full((len(x),), step / self.steps)) / self.steps
        return x
