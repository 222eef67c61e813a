"""Image encoders conditioned on the instruction, and layers from feature maps to tokens or keypoints.

Shapes: N images, C channels, H by W pixels, h by w positions of a feature map, M tokens or keypoints.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Kernels, Widths

POSITION_SCALE = 4.0  # of keypoint positions; large, because a hundredth of the image matters
BRIGHTNESS_OFFSET = 0.1  # of a brightness up to 3; suppresses the chromaticity of darker colours
INITIAL_CONTRAST = 2.0  # standard deviation of the scores of a token or keypoint; a few of 576 positions dominate
GELU_STD = 0.35  # about the standard deviation of the output of TokenLearner's first layer at initialisation
MIN_SCORE_STD = 1e-3
DARK = 0.05  # pixel value below which the logarithm of `log_pixels` becomes linear, so that noise in black stays small


class FiLM(nn.Module):
    """Scales and shifts every channel by a linear function of the text: (1 + gamma)·x + beta (arXiv 1709.07871).

    Args:
        text_width: length of the text vector.
        channels: C.
        identity: start with gamma = beta = 0, which leaves a pretrained network unchanged.
    """

    def __init__(self, text_width: int, channels: int, identity: bool) -> None:
        super().__init__()
        self.gamma, self.beta = nn.Linear(text_width, channels), nn.Linear(text_width, channels)
        if identity:
            for linear in (self.gamma, self.beta):
                nn.init.zeros_(linear.weight)
                nn.init.zeros_(linear.bias)

    def forward(self, x: Tensor, text: Tensor) -> Tensor:
        """Modulate (N, C, h, w) features by (N, text_width) text; same shape."""
        gamma, beta = self.gamma(text)[:, :, None, None], self.beta(text)[:, :, None, None]
        return x * (1 + gamma) + beta


class ImageEncoder(nn.Module, ABC):
    """Images and text → feature map.

    Args:
        channels: C of the feature map.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    @abstractmethod
    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """Encode (N, 3, H, W) float images in 0 … 1 with (N, text_width) text as (N, channels, h, w)."""


class FilmConv(ImageEncoder):
    """A few convolutions, each followed by FiLM, for training on a CPU.

    The activation is SiLU: without normalisation, ReLU left most of the few channels dead.

    Args:
        channels: output channels, one per convolution.
        kernels: kernel sizes, one per convolution [px].
        strides: strides, one per convolution.
        chroma: add colours relative to their brightness as input, which depend less on light and shadows.
        positions: append the position x, y of every feature, in ±POSITION_SCALE (CoordConv, arXiv 1807.03247). Without
            it, a weighted mean of features, such as a token of TokenLearner, does not tell where in the image they are.
        log_pixels: input logarithms of the pixel values, so that the same relative contrast counts as much on a dark
            surface as on a bright one.
        text_width: length of the text vector.
    """

    def __init__(
        self,
        channels: Widths,
        kernels: Kernels,
        strides: Kernels,
        chroma: bool,
        positions: bool,
        log_pixels: bool,
        *,
        text_width: int,
    ) -> None:
        if not len(channels) == len(kernels) == len(strides):
            raise UserError(
                f"model.image.channels, kernels and strides must be equally many, got {channels}, {kernels}, {strides}"
            )
        super().__init__(channels[-1] + 2 * positions)
        self.positions, self.log_pixels = positions, log_pixels
        inputs = [3, *channels[:-1]]
        convs = [
            nn.Conv2d(i, o, kernel, stride, kernel // 2)
            for i, o, kernel, stride in zip(inputs, channels, kernels, strides, strict=True)
        ]
        self.chroma: nn.Conv2d | None = None
        if chroma:
            self.chroma = nn.Conv2d(3, channels[0], kernels[0], strides[0], kernels[0] // 2, bias=False)
        for conv in (*convs, *([self.chroma] if self.chroma else [])):
            # Without normalisation layers the variance must be preserved, or attention over positions starts uniform.
            nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
        self.convs = nn.ModuleList(convs)
        self.films = nn.ModuleList(FiLM(text_width, c, identity=False) for c in channels)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """Encode (N, 3, H, W) float images in 0 … 1 with (N, text_width) text as (N, channels, h, w)."""
        scale = 1.0 if self.chroma is None else math.sqrt(0.5)  # keeps the variance of the sum of both inputs
        values = _logarithm(images) if self.log_pixels else images
        x = self.convs[0]((values - 0.5).mul_(4 * scale))  # about unit variance
        if self.chroma is not None:
            x = x + self.chroma(_chromaticity(images).mul_(6 * scale))
        x = F.silu(self.films[0](x, text))
        for conv, film in zip(self.convs[1:], self.films[1:], strict=True):
            x = F.silu(film(conv(x), text))
        if self.positions:
            height, width = x.shape[-2:]
            coordinates = (POSITION_SCALE * grid(x)).to(x.dtype).T.view(1, 2, height, width)
            x = torch.cat([x, coordinates.expand(len(x), -1, -1, -1)], 1)
        return x


def _logarithm(images: Tensor) -> Tensor:
    """Return the logarithm of pixel values, scaled so that 0 and 1 stay as they are."""
    return (images / DARK).log1p_().div_(math.log1p(1 / DARK))


def _chromaticity(images: Tensor) -> Tensor:
    """Return the shares of red, green and blue in the brightness of each pixel, minus 1/3; grey is 0."""
    brightness = images[:, 0] + images[:, 1] + images[:, 2] + BRIGHTNESS_OFFSET  # faster than .sum(1)
    return (images / brightness.unsqueeze(1)).sub_(1 / 3)


class TokenLearner(nn.Module):
    """M tokens per image, each an attention-weighted mean of the features (TokenLearner 1.1, arXiv 2106.11297).

    Args:
        channels: C of the feature map.
        tokens: M.
    """

    def __init__(self, channels: int, tokens: int) -> None:
        super().__init__()
        hidden = min(channels, 64)  # 64 as published
        score = nn.Linear(hidden, tokens)
        # As for keypoints: uniform attention averages the image away and has almost no gradient.
        nn.init.normal_(score.weight, std=INITIAL_CONTRAST / (GELU_STD * math.sqrt(hidden)))
        self.attention = nn.Sequential(
            nn.LayerNorm(channels, eps=1e-6), nn.Linear(channels, hidden), nn.GELU(approximate="tanh"), score
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map (N, C, h, w) features to (N, M, C) tokens."""
        values = features.flatten(2).mT  # (N, h·w, C)
        weights = self.attention(values).softmax(1).mT  # (N, M, h·w)
        return weights @ values


class Keypoints(nn.Module):
    """M keypoints per image: the mean position under the softmax of a feature map (spatial softmax, arXiv 1504.00702).

    Each also has the features averaged with the same weights, because a position does not contain orientation.

    The scores are normalised over each image to a standard deviation that is learned per keypoint. Otherwise most
    keypoints converge to uniform attention, which has no gradient.

    Args:
        channels: C of the feature map.
        keypoints: M.
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.width = 2 + channels
        self.score = nn.Linear(channels, keypoints, bias=False)
        self.contrast = nn.Parameter(torch.full((keypoints,), math.log(INITIAL_CONTRAST)))

    def forward(self, features: Tensor) -> Tensor:
        """Map (N, C, h, w) features to (N, M, 2 + C): positions x, y in ±POSITION_SCALE, and features."""
        values = features.flatten(2)  # (N, C, h·w)
        centred = values - values.mean(-1, keepdim=True)
        # The covariance of the few channels gives the variance of the scores at a fraction of the cost. `bmm` per image
        # avoids a copy before the softmax.
        covariance = torch.bmm(centred, centred.mT) / values.shape[-1]
        variance = (self.score.weight @ covariance * self.score.weight).sum(-1, keepdim=True)  # (N, M, 1)
        query = self.score.weight * self.contrast.exp()[:, None] / variance.clamp(min=MIN_SCORE_STD**2).sqrt()
        weights = torch.bmm(query, centred).softmax(-1)  # (N, M, h·w)
        positions = (POSITION_SCALE * grid(features)).expand(len(values), -1, -1)
        return torch.bmm(weights.float(), torch.cat([positions, values.mT.float()], -1))


def grid(features: Tensor) -> Tensor:
    """Return the positions x, y in -1 … 1 of (N, C, h, w) features, (h·w, 2) float32."""
    height, width = features.shape[-2:]
    y = torch.linspace(-1, 1, height, device=features.device)
    x = torch.linspace(-1, 1, width, device=features.device)
    return torch.stack([x.repeat(height), y.repeat_interleave(width)], -1)


class RandomShift(nn.Module):
    """Random shift augmentation: one offset for all images of a camera's clip, padded with black.

    It is the identity outside training.

    Args:
        vertical, horizontal: largest shift either way [1/256 of the image height].
    """

    def __init__(self, vertical: float, horizontal: float) -> None:
        super().__init__()
        self.vertical, self.horizontal = vertical, horizontal

    def forward(self, rgb: dict[str, Tensor]) -> dict[str, Tensor]:
        """Shift camera → (B, T, H, W, 3) images of B clips, all cameras in one pass; same shapes and types.

        Offsets are drawn on the device of the images, camera by camera.
        """
        if not self.training:
            return rgb
        images = [*rgb.values()]
        clips, frames, height, width, _ = images[0].shape
        top, left = round(self.vertical * height / 256), round(self.horizontal * height / 256)
        padded_height, padded_width = height + 2 * top, width + 2 * left
        padded = images[0].new_zeros(len(rgb), clips, frames, padded_height, padded_width, 3)
        for target, values in zip(padded, images, strict=True):
            target[:, :, top : top + height, left : left + width] = values
        device = padded.device
        offsets = [torch.randint(2 * margin + 1, (clips,), device=device) for _ in rgb for margin in (top, left)]
        row, column = torch.stack(offsets).view(len(rgb), 2, clips, 1, 1).unbind(1)  # (cameras, B, 1, 1) each
        origin = padded_height * torch.arange(len(rgb) * clips * frames, device=device).view(len(rgb), clips, frames, 1)
        starts = (origin + row + torch.arange(height, device=device)) * padded_width + column  # of rows [px]
        runs = padded.flatten().unfold(0, 3 * width, 3)  # a row's length of pixels from every pixel on, without a copy
        shifted = runs.index_select(0, starts.flatten()).view(len(rgb), *images[0].shape)
        return dict(zip(rgb, shifted, strict=True))
