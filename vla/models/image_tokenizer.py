"""Images as features that listen to the instruction, and features as a few tokens or keypoints.

Shapes: N images, C channels, H by W pixels, h by w positions of a feature map, M tokens or keypoints.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from difflib import get_close_matches
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import torch
import torch.nn.functional as F
from torch import Tensor, nn

log = logging.getLogger(__name__)

WEIGHTS = "model.safetensors"  # the name under which timm publishes the weights of a model


class FiLM(nn.Module):
    """Scales and shifts every channel by a linear function of the text: (1 + gamma)·x + beta (arXiv 1709.07871).

    Args:
        text_width: length of the text vector.
        channels: C.
        identity: start with gamma = beta = 0, so that a pretrained network is left as it was.
    """

    def __init__(self, text_width: int, channels: int, identity: bool) -> None:
        super().__init__()
        self.gamma, self.beta = nn.Linear(text_width, channels), nn.Linear(text_width, channels)
        if identity:
            for linear in (self.gamma, self.beta):
                nn.init.zeros_(linear.weight)
                nn.init.zeros_(linear.bias)

    def forward(self, x: Tensor, text: Tensor) -> Tensor:
        """(N, C, h, w) features and (N, text_width) text to (N, C, h, w)."""
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
        """(N, 3, H, W) float images in 0 … 1 and (N, text_width) text to (N, channels, h, w)."""


class FilmConv(ImageEncoder):
    """A few convolutions, each followed by FiLM; made to train on a CPU.

    Args:
        channels: output channels, one per convolution.
        kernels: kernel sizes, one per convolution [px].
        strides: strides, one per convolution.
        text_width: length of the text vector.
    """

    def __init__(self, channels: list[int], kernels: list[int], strides: list[int], *, text_width: int) -> None:
        if not channels or not len(channels) == len(kernels) == len(strides):
            raise ValueError(
                f"channels, kernels and strides need one entry per convolution, got {channels}, {kernels}, {strides}"
            )
        super().__init__(channels[-1])
        inputs = [3, *channels[:-1]]
        convs = [
            nn.Conv2d(i, o, kernel, stride, kernel // 2)
            for i, o, kernel, stride in zip(inputs, channels, kernels, strides, strict=True)
        ]
        for conv in convs:
            # Without normalisation layers the signal must keep its size, or the attention over positions starts flat.
            nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
        self.convs = nn.ModuleList(convs)
        self.films = nn.ModuleList(FiLM(text_width, c, identity=False) for c in channels)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """(N, 3, H, W) float images in 0 … 1 and (N, text_width) text to (N, channels, h, w)."""
        x = (images - 0.5) * 4  # about unit variance
        for conv, film in zip(self.convs, self.films, strict=True):
            x = F.relu_(film(conv(x), text))
        return x


class FilmEfficientNet(ImageEncoder):
    """An EfficientNet with FiLM after every block and after its final projection, as in RT-1 (arXiv 2212.06817).

    At the start every FiLM is the identity, so the features are exactly those of the EfficientNet.

    Args:
        name: an EfficientNet of timm.
        pretrained: true fetches ImageNet weights through timm or fails, false starts at random, "auto" fetches and
            falls back to random with a warning; anything else is the path of a weights file (.safetensors or .pth).
        channels: C of the feature map.
        text_width: length of the text vector.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        name: str = "efficientnet_b3",
        pretrained: bool | str = "auto",
        channels: int = 512,
        *,
        text_width: int,
    ) -> None:
        super().__init__(channels)
        net: Any = load_efficientnet(name, pretrained)
        self.stem = nn.Sequential(net.conv_stem, net.bn1)
        self.blocks = nn.ModuleList(block for stage in net.blocks for block in stage)
        self.films = nn.ModuleList(FiLM(text_width, _output_channels(b), identity=True) for b in self.blocks)
        self.top = nn.Sequential(net.conv_head, net.bn2)
        self.projection = nn.Conv2d(net.conv_head.out_channels, channels, 1, bias=False)
        self.last_film = FiLM(text_width, channels, identity=True)
        self.register_buffer("mean", torch.tensor(net.pretrained_cfg["mean"]).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(net.pretrained_cfg["std"]).view(3, 1, 1), persistent=False)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """(N, 3, H, W) float images in 0 … 1 and (N, text_width) text to (N, channels, h, w)."""
        x = self.stem((images - self.mean) / self.std)
        for block, film in zip(self.blocks, self.films, strict=True):
            x = film(block(x), text)
        features: Tensor = self.last_film(self.projection(self.top(x)), text)
        return features


def load_efficientnet(name: str, pretrained: bool | str) -> nn.Module:
    """An EfficientNet of timm without its classifier; `pretrained` as in `FilmEfficientNet`.

    Raises:
        ValueError: timm has no such EfficientNet, or the weights that were asked for cannot be had.
    """
    import timm  # slow to import, and needed by this one encoder only

    known = timm.list_models("*efficientnet*")
    if name not in known:
        raise ValueError(f"timm has no EfficientNet '{name}', it has {', '.join(get_close_matches(name, known, 5, 0))}")
    net: nn.Module = timm.create_model(name, num_classes=0)
    if not pretrained:
        log.info("%s starts at random", name)
    elif isinstance(pretrained, str) and pretrained != "auto":
        _load_weights(net, name, Path(pretrained))
    else:
        try:
            _load_weights(net, name, fetch_weights(name))
        except OSError as error:
            reason = str(error).partition("\n")[0]
            if pretrained is True:
                raise ValueError(
                    f"the ImageNet weights of {name} cannot be fetched ({reason}): give model.image.pretrained the "
                    "path of a weights file, or false to start at random"
                ) from error
            log.warning("%s starts at RANDOM: its ImageNet weights cannot be fetched (%s)", name, reason)
    return net


def fetch_weights(name: str) -> Path:
    """The file with timm's ImageNet weights of a model, downloaded unless it has been before.

    Raises:
        OSError: there are none, or the place where they are cannot be reached.
    """
    import timm
    from huggingface_hub import constants, hf_hub_download, try_to_load_from_cache

    config = timm.get_pretrained_cfg(name)
    if config is None or config.hf_hub_id is None:
        raise OSError("timm names none")
    cached = try_to_load_from_cache(config.hf_hub_id, WEIGHTS)
    if isinstance(cached, str):
        return Path(cached)
    # The download itself tries again for most of a minute before it gives up on a machine without network.
    urlopen(constants.ENDPOINT, timeout=10).close()
    return Path(hf_hub_download(config.hf_hub_id, WEIGHTS))


def _load_weights(net: nn.Module, name: str, path: Path) -> None:
    if not path.is_file():
        raise ValueError(f"model.image.pretrained is true, false, auto or a weights file, and there is no file {path}")
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        weights = load_file(path)
    else:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    try:
        net.load_state_dict({key: value for key, value in weights.items() if not key.startswith("classifier.")})
    except RuntimeError as error:
        raise ValueError(f"{path} does not hold the weights of timm's {name}: {str(error).splitlines()[-1]}") from error
    log.info("%s starts from the weights in %s", name, path)


def _output_channels(block: nn.Module) -> int:
    return [module for module in block.modules() if isinstance(module, nn.Conv2d)][-1].out_channels


class TokenLearner(nn.Module):
    """M tokens per image, each an attention-weighted mean of the features (TokenLearner 1.1, arXiv 2106.11297).

    Args:
        channels: C of the feature map.
        tokens: M.
    """

    def __init__(self, channels: int, tokens: int = 8) -> None:
        super().__init__()
        self.attention = nn.Sequential(
            nn.LayerNorm(channels, eps=1e-6),
            nn.Linear(channels, 64),
            nn.GELU(approximate="tanh"),
            nn.Linear(64, tokens),
        )

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, h, w) features to (N, M, C) tokens."""
        values = features.flatten(2).mT  # (N, h·w, C)
        weights = self.attention(values).softmax(1).mT  # (N, M, h·w)
        return weights @ values


class Keypoints(nn.Module):
    """M keypoints per image: the mean position under the softmax of a feature map (spatial softmax, arXiv 1504.00702).

    Each comes with the features found there, weighted alike: a position alone does not say how a thing is turned.

    Args:
        channels: C of the feature map.
        keypoints: M.
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.width = 2 + channels
        self.score = nn.Linear(channels, keypoints, bias=False)
        nn.init.normal_(self.score.weight, std=1.0)  # attention that starts flat sends no gradient

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, h, w) features to (N, M, 2 + C): positions x, y in -1 … 1, and features."""
        values = features.flatten(2)  # (N, C, h·w)
        weights = (self.score.weight @ values).softmax(-1)  # (N, M, h·w)
        return torch.cat([weights.float() @ grid(features), (weights @ values.mT).float()], -1)


def grid(features: Tensor) -> Tensor:
    """(h·w, 2) positions x, y in -1 … 1 of the (N, C, h, w) features, float32."""
    height, width = features.shape[-2:]
    y = torch.linspace(-1, 1, height, device=features.device)
    x = torch.linspace(-1, 1, width, device=features.device)
    return torch.stack([x.repeat(height), y.repeat_interleave(width)], -1)


class RandomShift(nn.Module):
    """Shifts the images of a clip by one random offset, filling with black; does nothing outside training.

    Whoever compiles it leaves it out: offsets are numbers here, and every new one would be compiled anew.

    Args:
        vertical, horizontal: largest shift either way [1/256 of the image height].
    """

    def __init__(self, vertical: float, horizontal: float) -> None:
        super().__init__()
        self.vertical, self.horizontal = vertical, horizontal

    def forward(self, images: Tensor) -> Tensor:
        """(B, T, H, W, 3) images of B clips to the same shape and type."""
        if not self.training:
            return images
        clips, frames, height, width, _ = images.shape
        up, left = round(self.vertical * height / 256), round(self.horizontal * height / 256)
        padded = images.new_zeros(clips, frames, height + 2 * up, width + 2 * left, 3)
        padded[:, :, up : up + height, left : left + width] = images
        rows = torch.randint(2 * up + 1, (clips,)).tolist()
        columns = torch.randint(2 * left + 1, (clips,)).tolist()
        crops = zip(padded, rows, columns, strict=True)
        return torch.stack([clip[:, row : row + height, column : column + width] for clip, row, column in crops])
