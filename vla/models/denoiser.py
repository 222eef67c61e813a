"""What diffusion and flow matching share: a network that tells action from noise, and how it is trained.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token, R noisy copies, S truth
scalars.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

from vla.models.action_tokenizer import ActionTokenizer
from vla.models.chunks import ChunkModel, mean_where
from vla.models.image_tokenizer import ImageEncoder
from vla.models.model import Batch, Prediction, require_heads
from vla.models.text import TextEncoder
from vla.spec import Spec
from vla.types import Layers, NonNegative, Shift, Steps, Width

FASTEST, SLOWEST = 100.0, 1.0  # frequencies of the embedding of time, which runs from 0 to 1 [rad]


class Denoiser(nn.Module):
    """A transformer from a noisy chunk and what is seen to a vector for every action.

    An action sees those before it and not those after: what follows the last valid action cannot reach it.

    Args:
        components: D.
        chunk: k.
        width: E.
        layers, heads: of the transformer.
    """

    mask: Tensor

    def __init__(self, components: int, chunk: Steps, width: int, layers: Layers, heads: Layers) -> None:
        super().__init__()
        self.width = width
        self.action = nn.Linear(components, width)
        self.positions = nn.Embedding(chunk, width)
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        layer = nn.TransformerDecoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
        self.transformer = nn.TransformerDecoder(layer, layers, nn.LayerNorm(width))
        self.head = nn.Linear(width, components)
        self.register_buffer("mask", torch.ones(chunk, chunk, dtype=torch.bool).triu(1), persistent=False)

    def forward(self, noisy: Tensor, time: Tensor, context: Tensor) -> Tensor:
        """(B, k, D) at (B,) times in 0 … 1, with (B, M, E) of what is seen, to (B, k, D)."""
        when = self.time(waves(time, self.width)).unsqueeze(1)  # (B, 1, E)
        tokens = self.action(noisy) + self.positions.weight + when
        hidden: Tensor = self.head(self.transformer(tokens, context, self.mask, tgt_is_causal=True))
        return hidden


def waves(time: Tensor, width: int) -> Tensor:
    """(B,) times in 0 … 1 as (B, width) sines and cosines of many frequencies."""
    steps = torch.linspace(math.log(SLOWEST), math.log(FASTEST), width // 2, device=time.device)
    angle = time.float().unsqueeze(-1) * steps.exp()
    return torch.cat([angle.sin(), angle.cos()], -1)


class DenoisingModel(ChunkModel):
    """A model that starts from noise and takes it away in a few steps, looking at the scene only once.

    What it does is drawn: with the same "noise" in the batch it is the same, and without any the noise is fixed.
    Outside training nothing depends on, or changes, the state of torch's random numbers.

    Args:
        image, text, chunk, execute, keypoints, text_width, width: as in `ChunkModel`.
        layers, heads: of the denoiser.
        copies: R, how often each chunk of a training batch is made noisy; all copies share the work on its images.
        steps: in which noise becomes actions.
        temperature: factor of the noise at the start: 1 draws from what was learned, 0 always takes its middle, and
            what is between is steadier than the one and more varied than the other.
        shift, auxiliary: as in `ChunkModel`.
        spec: what a step looks like.
        tokenizer: between which bounds actions lie.

    Raises:
        ValueError: `width` is odd or no multiple of `heads`, or `execute` is more than `chunk`.
    """

    noise: Tensor

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        chunk: Steps = 8,
        execute: Steps = 2,
        keypoints: Width = 32,
        text_width: Width = 64,
        width: Width = 128,
        layers: Layers = 3,
        heads: Layers = 4,
        copies: Steps = 2,
        steps: Steps = 10,
        temperature: NonNegative = 0.5,
        shift: Shift = (12, 12),
        auxiliary: NonNegative = 1.0,
        *,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        require_heads(width, heads)
        if width % 2:
            raise ValueError(f"model.width={width} must be even, for pairs of a sine and a cosine")
        super().__init__(
            image=image,
            text=text,
            chunk=chunk,
            execute=execute,
            keypoints=keypoints,
            text_width=text_width,
            width=width,
            shift=shift,
            auxiliary=auxiliary,
            spec=spec,
            tokenizer=tokenizer,
        )
        self.copies, self.steps, self.temperature = copies, steps, temperature
        self.denoiser = Denoiser(len(spec.action), chunk, width, layers, heads)
        noise = torch.randn(chunk, len(spec.action), generator=torch.Generator().manual_seed(0))
        self.register_buffer("noise", noise, persistent=False)

    @abstractmethod
    def corrupt(self, action: Tensor, noise: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Noisy actions, (B,) times and what the denoiser shall say of them.

        The (B, k, D) actions are scaled; noise of the same shape is standard normal; (B,) `uniform` is in 0 … 1.
        """

    @abstractmethod
    def sample(self, noise: Tensor, context: Tensor) -> Tensor:
        """The (B, k, D) scaled actions that (B, k, D) noise becomes in view of the (B, M, E) context."""

    def draw(self, random: torch.Generator) -> Tensor:
        """(1, k, D) standard normal."""
        return torch.randn(1, *self.noise.shape, generator=random)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """context: (B, M, E); with an auxiliary head, truth: (B, 1, S), standardised."""
        return self.see(batch, self.standing(batch))

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """The mean squared error of the denoiser on noisy copies of the chunks."""
        action = self.scaled(batch["action"][:, -1]).repeat(self.copies, 1, 1)  # (R·B, k, D)
        context = output["context"].repeat(self.copies, 1, 1)
        generator = None if self.training else torch.Generator().manual_seed(0)
        noise = torch.randn(action.shape, generator=generator).to(action)
        uniform = torch.rand(len(action), generator=generator).to(action)
        noisy, time, target = self.corrupt(action, noise, uniform)
        error = (self.denoiser(noisy, time, context).float() - target).square()
        return {"action_loss": mean_where(error, batch["valid"][:, -1].repeat(self.copies, 1))}

    def predict(self, batch: Batch) -> Prediction:
        """What becomes of the batch's "noise", or of noise that is always the same."""
        context = self(batch)["context"]
        noise = batch["noise"] if "noise" in batch else self.noise.expand(len(context), -1, -1)
        return Prediction(self.unscaled(self.sample(self.temperature * noise, context)))
