"""Layers and functions that models share.

Shapes: B batch, T frames, E width of a token.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from vla.io.errors import UserError

Batch = dict[str, Any]


class RunningNormalizer(nn.Module):
    """Normalisation to zero mean and unit variance by running statistics, which are saved with the weights.

    Unlike those of batch normalisation, the statistics are of all batches so far, in all processes of a training.

    Args:
        width: number of components.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    MIN_STD = 1e-3  # a component that is constant in the data must not explode when it moves
    LIMIT = 5.0  # standard deviations; values are clipped to it

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("variance", torch.zeros(width))

    @property
    def std(self) -> Tensor:
        """Return the standard deviations, (width,)."""
        return self.variance.sqrt().clamp(min=self.MIN_STD)

    def forward(self, values: Tensor, present: Tensor) -> Tensor:
        """Normalise (B, T, width) values where the (B, T) bool `present` is true; the others become 0."""
        if self.training:
            self._update(values.detach(), present.unsqueeze(-1).to(values.dtype))
        normalized = ((values - self.mean) / self.std).clamp(-self.LIMIT, self.LIMIT)
        return normalized * present.unsqueeze(-1)

    def _update(self, values: Tensor, weight: Tensor) -> None:
        batch_count = _sum_over_processes(weight.sum())
        total = (self.count + batch_count).clamp(min=1)
        mean = _sum_over_processes((values * weight).sum((0, 1))) / batch_count.clamp(min=1)
        squares = _sum_over_processes(((values - mean).square() * weight).sum((0, 1)))
        # Parallel variance algorithm (Chan et al. 1979).
        shift = mean - self.mean
        correction = shift.square() * self.count * batch_count / total
        self.variance.copy_((self.variance * self.count + squares + correction) / total)
        self.mean.add_(shift * batch_count / total)
        self.count.add_(batch_count)


def _sum_over_processes(tensor: Tensor) -> Tensor:
    """Sum a tensor in place over all processes of a training."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.all_reduce(tensor)
    return tensor


def mean_where(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of values where the bool mask of the same shape is true; 0 if it is all false."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


def exact_product(left: Tensor, right: Tensor) -> Tensor:
    """Return the product of small matrices, (…, N, K) and (…, K, M), in full float32 precision.

    Autocast would round the factors to bfloat16, and training on a GPU to TensorFloat-32, with a 10-bit mantissa.
    """
    if left.is_cuda:
        return (left.unsqueeze(-1) * right.unsqueeze(-3)).sum(-2)
    with torch.autocast(left.device.type, enabled=False):
        return left @ right


def random_arguments(training: bool, device: torch.device) -> dict[str, Any]:
    """Return arguments for torch's random functions, which outside training give the same numbers on every device.

    In training, numbers are drawn on the device: a copy from the CPU would wait until the device finishes its work.
    """
    return {"device": device} if training else {"generator": torch.Generator().manual_seed(0)}


def newest_index(present: Tensor) -> Tensor:
    """Return the (B,) index of the last of the (B, T) frames that is present."""
    return (present * torch.arange(1, present.shape[1] + 1, device=present.device)).argmax(1)


def pixels(images: Tensor) -> Tensor:
    """Convert (B, T, H, W, 3) uint8 to (B·T, 3, H, W) float32 in 0 … 1."""
    return images.flatten(0, 1).permute(0, 3, 1, 2).float().div_(255)


def mlp(inputs: int, width: int) -> nn.Sequential:
    """Build an MLP of three layers from `inputs` to `width` features, with layer normalisation and GELU."""
    input_layers = [nn.Linear(inputs, width), nn.LayerNorm(width), nn.GELU()]
    hidden_layers = [nn.Linear(width, width), nn.LayerNorm(width), nn.GELU()]
    return nn.Sequential(*input_layers, *hidden_layers, nn.Linear(width, width), nn.GELU())


def transformer_encoder(width: int, layers: int, heads: int) -> nn.Module:
    """Build a pre-norm transformer encoder without dropout; a UserError unless `heads` divide `width`."""
    require_heads(width, heads)
    layer = nn.TransformerEncoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
    return nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)


def transformer_decoder(width: int, layers: int, heads: int) -> nn.Module:
    """Build a pre-norm transformer decoder without dropout; a UserError unless `heads` divide `width`."""
    require_heads(width, heads)
    layer = nn.TransformerDecoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
    return nn.TransformerDecoder(layer, layers, nn.LayerNorm(width))


def require_heads(width: int, heads: int) -> None:
    """Raise a UserError unless `width` is a multiple of `heads`."""
    if width % heads:
        raise UserError(f"model.width={width} must be a multiple of model.heads={heads}")
