"""ACT: a transformer that predicts a chunk of actions at once, trained as a conditional variational autoencoder.

T. Zhao, V. Kumar, S. Levine, C. Finn, "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv
2304.13705.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token, Z latent, S truth scalars.
"""

from __future__ import annotations

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


class Style(nn.Module):
    """The CVAE's encoder: from how the arm stands and what it then did to a normal distribution of the latent.

    Args:
        posture_width: length of the posture.
        components: D.
        chunk: k.
        width: E.
        layers, heads: of the transformer.
        latent: Z.
    """

    def __init__(
        self,
        posture_width: int,
        components: int,
        chunk: Steps,
        width: int,
        layers: Layers,
        heads: Layers,
        latent: Width,
    ) -> None:
        super().__init__()
        self.start = nn.Embedding(1, width)
        self.posture = nn.Linear(posture_width, width)
        self.action = nn.Linear(components, width)
        self.positions = nn.Embedding(2 + chunk, width)
        self.encoder = encoder(width, layers, heads)
        self.head = nn.Linear(width, 2 * latent)

    def forward(self, standing: Tensor, action: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance, (B, Z) each, for (B, posture_width), (B, k, D) scaled actions and (B, k) bool."""
        start = self.start.weight.expand(len(action), 1, -1)
        tokens = torch.cat([start, self.posture(standing).unsqueeze(1), self.action(action)], 1)  # (B, 2 + k, E)
        absent = torch.cat([valid.new_zeros(len(valid), 2), ~valid], 1)
        hidden = self.encoder(tokens + self.positions.weight, src_key_padding_mask=absent)[:, 0]
        mean, log_variance = self.head(hidden).chunk(2, -1)
        return mean, log_variance


class ACT(ChunkModel):
    """Action chunking with transformers: k learned queries look at what is seen, and become k actions.

    In training a latent tells apart the ways in which the same was done; acting, and in validation, it is the prior's
    mean, 0.

    Args:
        image, text, chunk, execute, keypoints, text_width, width, shift, auxiliary: as in `ChunkModel`.
        layers: of the encoder over the context, of the decoder, and of the CVAE's encoder.
        heads: number of attention heads.
        latent: Z.
        kl_weight: weight of the divergence of the latent from its prior; 0 leaves latent and CVAE encoder out.
        spec: what a step looks like.
        tokenizer: between which bounds actions lie.

    Raises:
        ValueError: `width` is no multiple of `heads`, or `execute` is more than `chunk`.
    """

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        chunk: Steps = 8,
        execute: Steps = 2,
        keypoints: Width = 32,
        text_width: Width = 64,
        width: Width = 128,
        layers: Layers = 2,
        heads: Layers = 4,
        latent: Width = 32,
        kl_weight: NonNegative = 10.0,
        shift: Shift = (12, 12),
        auxiliary: NonNegative = 1.0,
        *,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        require_heads(width, heads)
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
        self.kl_weight, self.latent = kl_weight, latent
        if kl_weight > 0:
            self.style = Style(self.posture_width, len(spec.action), chunk, width, layers, heads, latent)
            self.latent_token = nn.Linear(latent, width)
        self.kinds = nn.Embedding(1 + len(self.tokens) + (kl_weight > 0), width)  # which token is which
        self.encoder = encoder(width, layers, heads)
        self.queries = nn.Embedding(chunk, width)
        self.decoder = decoder(width, layers, heads)
        self.head = nn.Linear(width, len(spec.action))

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """actions: (B, k, D), scaled; in training also mean and log_variance of the latent, (B, Z) each; with an
        auxiliary head truth: (B, 1, S), standardised."""
        standing = self.standing(batch)
        output = self.see(batch, standing)
        context = output.pop("context")
        if self.kl_weight > 0:
            latent = context.new_zeros(len(context), self.latent)
            if self.training:
                action, valid = batch["action"][:, -1], batch["valid"][:, -1]
                mean, log_variance = self.style(standing, self.scaled(action), valid)
                latent = mean + (log_variance / 2).exp() * torch.randn_like(mean)
                output |= {"mean": mean, "log_variance": log_variance}
            context = torch.cat([context, self.latent_token(latent).unsqueeze(1)], 1)
        memory = self.encoder(context + self.kinds.weight)
        queries = self.queries.weight.expand(len(context), -1, -1)
        return output | {"actions": self.head(self.decoder(queries, memory))}

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """The mean distance of the scaled actions and, in training, the weighted divergence of the latent."""
        distance = (output["actions"].float() - self.scaled(batch["action"][:, -1])).abs()  # (B, k, D)
        losses = {"action_loss": mean_where(distance, batch["valid"][:, -1])}
        if "mean" in output:
            mean, log_variance = output["mean"].float(), output["log_variance"].float()
            divergence = (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1) / 2  # (B,)
            losses["divergence"] = divergence.mean()
            losses["action_loss"] = losses["action_loss"] + self.kl_weight * losses["divergence"]
        return losses

    def predict(self, batch: Batch) -> Prediction:
        """The actions of the latent that is most likely before anything is done."""
        return Prediction(self.unscaled(self(batch)["actions"]))


def encoder(width: int, layers: int, heads: int) -> nn.Module:
    """A transformer without dropout whose tokens all see each other."""
    layer = nn.TransformerEncoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
    return nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)


def decoder(width: int, layers: int, heads: int) -> nn.Module:
    """A transformer without dropout whose tokens see each other and a memory."""
    layer = nn.TransformerDecoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
    return nn.TransformerDecoder(layer, layers, nn.LayerNorm(width))
