"""Base class of diffusion and flow matching: the denoising network and its training.

Shapes: B batch, k action chunk, D action components, M context tokens, E their width, R noisy copies, S truth scalars.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Inherited, Layers, NonNegative, Steps
from vla.models.chunking import after_prefix, with_prefix
from vla.models.layers import Batch, mean_where, random_arguments, transformer_decoder
from vla.models.model import ContextModel, Prediction

Denoise = Callable[[Tensor, Tensor], Tensor]  # noisy actions (B, k, D) and times → (B, k, D), with a context
MAX_FREQUENCY, MIN_FREQUENCY = 100.0, 1.0  # of the time embedding [rad]; time runs from 0 to 1


class Denoiser(nn.Module):
    """A transformer that maps a noisy chunk and its context to one vector per action.

    Self-attention is causal, so that padding after the last valid action has no effect.

    Args:
        components: D.
        chunk: k.
        width: E.
        layers, heads: of the transformer.
    """

    mask: Tensor

    def __init__(self, components: int, chunk: int, width: int, layers: int, heads: int) -> None:
        super().__init__()
        self.width = width
        self.action = nn.Linear(components, width)
        self.positions = nn.Embedding(chunk, width)
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.transformer = transformer_decoder(width, layers, heads)
        self.head = nn.Linear(width, components)
        self.register_buffer("mask", torch.ones(chunk, chunk, dtype=torch.bool).triu(1), persistent=False)

    def forward(self, noisy: Tensor, time: Tensor, context: Tensor, padding: Tensor | None = None) -> Tensor:
        """Map (B, k, D) noisy actions at (B,) or (B, k) times in 0 … 1 to (B, k, D).

        The (B, M, E) context has a (B, M) bool mask, true for padding; None: there is none.
        """
        time_token = self.time(sinusoidal_embedding(time, self.width))
        time_token = time_token if time.dim() > 1 else time_token.unsqueeze(1)  # (B, k or 1, E)
        tokens = self.action(noisy) + self.positions.weight + time_token
        hidden = self.transformer(tokens, context, self.mask, memory_key_padding_mask=padding, tgt_is_causal=True)
        return self.head(hidden)


def sinusoidal_embedding(time: Tensor, width: int) -> Tensor:
    """Embed times (…) in 0 … 1 as (…, width) sines and cosines."""
    exponents = torch.linspace(math.log(MIN_FREQUENCY), math.log(MAX_FREQUENCY), width // 2, device=time.device)
    angle = time.float().unsqueeze(-1) * exponents.exp()
    return torch.cat([angle.sin(), angle.cos()], -1)


class DenoisingModel(ContextModel):
    """A model that denoises a chunk in a few steps, conditioned on a context that is computed once.

    Predictions are samples determined by "noise" in the batch; without it a fixed noise is used. Outside training
    torch's global random state is neither read nor changed.

    Args:
        layers, heads: of the denoiser.
        copies: R, number of noisy copies of each chunk in a training batch; all copies share its image features.
        steps: number of denoising steps.
        temperature: factor of the initial noise: 1 samples the learned distribution, 0 is deterministic.

    Raises:
        UserError: `width` is odd or not a multiple of `heads`.
    """

    uses_tokens = False

    noise: Tensor

    def __init__(
        self,
        layers: Layers,
        heads: Layers,
        copies: Steps,
        steps: Steps,
        temperature: NonNegative,
        **inherited: Inherited,
    ) -> None:
        super().__init__(**inherited)
        if self.width % 2:
            raise UserError(f"model.width={self.width} must be even, for pairs of a sine and a cosine")
        self.copies, self.steps, self.temperature = copies, steps, temperature
        components = len(self.spec.action)
        self.denoiser = Denoiser(components, self.chunk, self.width, layers, heads)
        noise = torch.randn(self.chunk, components, generator=torch.Generator().manual_seed(0))
        self.register_buffer("noise", noise, persistent=False)

    @abstractmethod
    def corrupt(self, action: Tensor, noise: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return noisy actions, (B,) times and the regression target of the denoiser.

        The (B, k, D) actions are scaled; noise of the same shape is standard normal; (B,) `uniform` is in 0 … 1.
        """

    @abstractmethod
    def sample(self, noise: Tensor, denoise: Denoise) -> Tensor:
        """Denoise (B, k, D) noise to scaled actions, (B, k, D), in several steps."""

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return context: (B, M, E), padding: (B, M) unless there is none, and the result of `predict_truth`."""
        encoded = self.encode_context(batch)
        padding = {} if encoded.padding is None else {"padding": encoded.padding}
        return {"context": encoded.tokens, **padding, **self.predict_truth(encoded.summary.unsqueeze(1))}

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error of the denoiser on noisy copies of the chunks."""
        action = self.scaled(batch["action"][:, -1]).repeat(self.copies, 1, 1)  # (R·B, k, D)
        context = output["context"].repeat(self.copies, 1, 1)
        padding = output["padding"].repeat(self.copies, 1) if "padding" in output else None
        options = random_arguments(self.training, action.device)
        noise = torch.randn(action.shape, **options).to(action)
        uniform = torch.rand(len(action), **options).to(action)
        noisy, time, target = self.corrupt(action, noise, uniform)
        mask = batch["valid"][:, -1].repeat(self.copies, 1)
        if self.prefix:
            executed = self.scaled(batch["executed"][:, -1]).repeat(self.copies, 1, 1)
            length = torch.randint(self.prefix + 1, (len(action),), **options).to(time.device)
            noisy, time = with_prefix(noisy, time, executed, length)
            mask = after_prefix(batch["perturbations"][:, -1].repeat(self.copies, 1), length)
        error = (self.denoiser(noisy, time, context, padding).float() - target).square()
        return {"action_loss": mean_where(error.mean(-1), mask)}

    def predict(self, batch: Batch) -> Prediction:
        """Denoise the "noise" of the batch, or else a fixed noise."""
        encoded = self.encode_context(batch)
        noise = batch["noise"] if "noise" in batch else self.noise.expand(len(encoded.tokens), -1, -1)
        denoise = self.continuing_velocity(
            partial(self.denoiser, context=encoded.tokens, padding=encoded.padding), batch
        )
        return Prediction(self.unscaled(self.sample(self.temperature * noise, denoise)))
