"""ACT: a transformer that predicts a chunk of actions at once, trained as a conditional variational autoencoder.

T. Zhao, V. Kumar, S. Levine, C. Finn, "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv
2304.13705.

Shapes: B batch, k action chunk, D action components, M context tokens, E width of a token, Z latent, S truth scalars.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.types import Inherited, Layers, NonNegative, Width
from vla.models.layers import Batch, mean_where, transformer_decoder, transformer_encoder
from vla.models.model import ContextModel, Prediction


class _CVAEEncoder(nn.Module):
    """Encoder of the conditional VAE: robot state and action chunk → normal distribution of the latent.

    Args:
        robot_state_width: length of the robot state; 0 omits it.
        components: D.
        chunk: k.
        width: E.
        layers, heads: of the transformer.
        latent: Z.
    """

    def __init__(
        self, robot_state_width: int, components: int, chunk: int, width: int, layers: int, heads: int, latent: int
    ) -> None:
        super().__init__()
        self.start = nn.Embedding(1, width)
        if robot_state_width:
            self.robot_state = nn.Linear(robot_state_width, width)
        self.action = nn.Linear(components, width)
        self.positions = nn.Embedding(1 + (robot_state_width > 0) + chunk, width)
        self.encoder = transformer_encoder(width, layers, heads)
        self.head = nn.Linear(width, 2 * latent)

    def forward(self, robot_state: Tensor | None, action: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log variance, (B, Z) each, of the latent.

        Inputs: the (B, robot_state_width) state, if it is used, (B, k, D) scaled actions and their (B, k) bool mask.
        """
        prefix = self.start.weight.expand(len(action), 1, -1)
        if robot_state is not None:
            prefix = torch.cat([prefix, self.robot_state(robot_state).unsqueeze(1)], 1)
        tokens = torch.cat([prefix, self.action(action)], 1)
        padding = torch.cat([valid.new_zeros(prefix.shape[:2]), ~valid], 1)
        hidden = self.encoder(tokens + self.positions.weight, src_key_padding_mask=padding)[:, 0]
        mean, log_variance = self.head(hidden).chunk(2, -1)
        return mean, log_variance


class ACT(ContextModel):
    """Action chunking with transformers: k learned queries attend to the context and become k actions.

    In training a latent variable encodes the style of a demonstration. Outside training it is 0, the mean of its prior.

    Args:
        layers: number of layers in each of the context encoder, the decoder and the CVAE encoder.
        heads: number of attention heads.
        latent: Z.
        kl_weight: weight of the KL divergence of the latent from its prior; 0 omits latent and CVAE encoder.

    Raises:
        UserError: `width` is not a multiple of `heads`.
    """

    uses_tokens = False

    def __init__(
        self, layers: Layers, heads: Layers, latent: Width, kl_weight: NonNegative, **inherited: Inherited
    ) -> None:
        super().__init__(**inherited)
        width, components = self.width, len(self.spec.action)
        self.kl_weight, self.latent = kl_weight, latent
        if kl_weight > 0:
            state = self.context.state_width
            self.cvae_encoder = _CVAEEncoder(state, components, self.chunk, width, layers, heads, latent)
            self.latent_token = nn.Linear(latent, width)
        self.token_types = nn.Embedding(self.context.length + (kl_weight > 0), width)  # type embeddings
        self.encoder = transformer_encoder(width, layers, heads)
        self.queries = nn.Embedding(self.chunk, width)
        self.decoder = transformer_decoder(width, layers, heads)
        self.head = nn.Linear(width, components)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return actions: (B, k, D), scaled.

        In training also mean and log_variance: (B, Z) each; with an auxiliary head truth: (B, 1, S), normalised.
        """
        encoded = self.encode_context(batch)
        context, padding = encoded.tokens, encoded.padding
        output = self.predict_truth(encoded.summary.unsqueeze(1))
        if self.kl_weight > 0:
            latent = context.new_zeros(len(context), self.latent)
            if self.training:
                action, valid = batch["action"][:, -1], batch["valid"][:, -1]
                mean, log_variance = self.cvae_encoder(encoded.state, self.scaled(action), valid)
                latent = mean + (log_variance / 2).exp() * torch.randn_like(mean)
                output |= {"mean": mean, "log_variance": log_variance}
            context = torch.cat([context, self.latent_token(latent).unsqueeze(1)], 1)
            padding = None if padding is None else F.pad(padding, (0, 1))
        memory = self.encoder(context + self.token_types.weight, src_key_padding_mask=padding)
        queries = self.queries.weight.expand(len(context), -1, -1)
        return output | {"actions": self.head(self.decoder(queries, memory, memory_key_padding_mask=padding))}

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the L1 error of the scaled actions plus, in training, the weighted KL divergence of the latent."""
        distance = (output["actions"].float() - self.scaled(batch["action"][:, -1])).abs()  # (B, k, D)
        losses = {"action_loss": mean_where(distance.mean(-1), batch["valid"][:, -1])}
        if "mean" in output:
            mean, log_variance = output["mean"].float(), output["log_variance"].float()
            divergence = (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1) / 2  # (B,)
            losses["divergence"] = divergence.mean()
            losses["action_loss"] = losses["action_loss"] + self.kl_weight * losses["divergence"]
        return losses

    def predict(self, batch: Batch) -> Prediction:
        """Predict with the latent at the mean of its prior, 0."""
        return Prediction(self.unscaled(self(batch)["actions"]))
