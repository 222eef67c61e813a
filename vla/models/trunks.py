"""Image encoders around networks of timm, most of them with weights that were trained on something else.

Shapes: N images, C channels, H by W pixels, h by w positions of a feature map.
"""

from __future__ import annotations

import logging
from difflib import get_close_matches
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.models.hub import fetch
from vla.models.image_tokenizer import FiLM, ImageEncoder
from vla.types import Pixels, Width

log = logging.getLogger(__name__)

WEIGHTS = "model.safetensors"  # the name under which timm publishes the weights of a network


class Normalize(nn.Module):
    """Colours as a network of timm wants them.

    Args:
        trunk: the network.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, trunk: Any) -> None:
        super().__init__()
        for name in ("mean", "std"):
            self.register_buffer(name, torch.tensor(trunk.pretrained_cfg[name]).view(3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """(N, 3, H, W) images in 0 … 1 to about zero mean and unit variance."""
        return (images - self.mean) / self.std


class FilmEfficientNet(ImageEncoder):
    """An EfficientNet with FiLM after every block and after its final projection, as in RT-1 (arXiv 2212.06817).

    At the start every FiLM is the identity, so the features are exactly those of the EfficientNet.

    Args:
        name: an EfficientNet of timm.
        pretrained: true fetches timm's weights or fails, false starts at random, "auto" fetches them and falls back to
            random with a warning; anything else is the path of a weights file (.safetensors or .pth), and an empty
            text leaves the weights to the checkpoint that is loaded.
        channels: C of the feature map.
        text_width: length of the text vector.
    """

    def __init__(
        self,
        name: str = "efficientnet_b3",
        pretrained: bool | str = "auto",
        channels: Width = 512,
        *,
        text_width: int,
    ) -> None:
        super().__init__(channels)
        net = load_trunk(name, pretrained, kind="efficientnet")
        self.normalize = Normalize(net)
        self.stem = nn.Sequential(net.conv_stem, net.bn1)
        self.blocks = nn.ModuleList(block for stage in net.blocks for block in stage)
        self.films = nn.ModuleList(FiLM(text_width, _output_channels(b), identity=True) for b in self.blocks)
        self.top = nn.Sequential(net.conv_head, net.bn2)
        self.projection = nn.Conv2d(net.conv_head.out_channels, channels, 1, bias=False)
        self.last_film = FiLM(text_width, channels, identity=True)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """(N, 3, H, W) float images in 0 … 1 and (N, text_width) text to (N, channels, h, w)."""
        x = self.stem(self.normalize(images))
        for block, film in zip(self.blocks, self.films, strict=True):
            x = film(block(x), text)
        features: Tensor = self.last_film(self.projection(self.top(x)), text)
        return features


class FilmTrunk(ImageEncoder):
    """The last feature map of any network of timm, such as DINO and SigLIP, projected and with FiLM on it.

    A transformer's feature map are its normalised patch tokens, where their patches lie in the image. At the start
    FiLM is the identity.

    Args:
        name: a network of timm, with or without the tag of its weights.
        pretrained: as in `FilmEfficientNet`.
        frozen: leave the network as it is, and learn to read it.
        size: images are resized to this height and width [px]; null is the size that the network was trained with.
        channels: C of the feature map.
        text_width: length of the text vector.

    Raises:
        ValueError: timm has no such network, it takes no images of this size, or the weights that were asked for cannot
            be had.
    """

    def __init__(
        self,
        name: str,
        pretrained: bool | str = "auto",
        frozen: bool = True,
        size: Pixels | None = None,
        channels: Width = 128,
        *,
        text_width: int,
    ) -> None:
        super().__init__(channels)
        self.trunk = load_trunk(name, pretrained, size=size)
        self.trunk.prune_intermediate_layers(1, prune_norm=False, prune_head=True)
        last = self.trunk.feature_info[-1]
        if size is not None and size % last["reduction"]:
            raise ValueError(f"model.image.size={size} must be a multiple of {last['reduction']} px for {name}")
        self.size = size or self.trunk.pretrained_cfg["input_size"][-1]
        self.frozen = frozen
        self.normalized = "hiera" not in name  # the one family whose maps have no normalisation of their own
        self.trunk.requires_grad_(not frozen)
        self.normalize = Normalize(self.trunk)
        self.projection = nn.Conv2d(last.get("num_chs_norm", last["num_chs"]), channels, 1, bias=False)
        self.film = FiLM(text_width, channels, identity=True)

    def train(self, mode: bool = True) -> FilmTrunk:
        """As every module, but a frozen network stays as it is evaluated."""
        super().train(mode)
        if self.frozen:
            self.trunk.eval()
        return self

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """(N, 3, H, W) float images in 0 … 1 and (N, text_width) text to (N, channels, h, w)."""
        x = F.interpolate(images, (self.size, self.size), mode="bilinear")
        (features,) = self.trunk.forward_intermediates(
            self.normalize(x), indices=1, norm=self.normalized, output_fmt="NCHW", intermediates_only=True
        )
        modulated: Tensor = self.film(self.projection(features), text)
        return modulated


def load_trunk(name: str, pretrained: bool | str, kind: str = "", size: int | None = None) -> Any:
    """A network of timm without its classifier; `pretrained` as in `FilmEfficientNet`.

    Args:
        kind: what its name must contain.
        size: height and width of the images [px], for a network that wants to know.

    Raises:
        ValueError: timm has no such network, or the weights that were asked for cannot be had.
    """
    import timm  # slow to import, and not needed by every policy

    pattern = f"*{kind}*"
    known = {*timm.list_models(pattern), *timm.list_pretrained(pattern)}
    if name not in known:
        close = ", ".join(get_close_matches(name, known, 5, 0))
        raise ValueError(f"timm has no {kind or 'network'} called '{name}', it has {close} and others")
    config: Any = timm.get_pretrained_cfg(name)
    options: dict[str, Any] = {"num_classes": 0, "img_size": size if config.fixed_input_size else None}
    path = _weights_file(name, config.hf_hub_id, pretrained)
    if path is None:
        return timm.create_model(name, **options)
    # Without a classifier on either side, timm lets nothing be missing, and nothing be left over.
    weights = _read(path, config.classifier)
    overlay = {"state_dict": weights, "classifier": None, "num_classes": 0}
    try:
        net: Any = timm.create_model(name, pretrained=True, pretrained_cfg_overlay=overlay, **options)
    except RuntimeError as error:
        raise ValueError(f"{path} does not hold the weights of timm's {name}: {str(error).splitlines()[-1]}") from error
    del net.pretrained_cfg["state_dict"]
    log.info("%s starts from the weights in %s", name, path)
    return net


def _weights_file(name: str, repository: str | None, pretrained: bool | str) -> Path | None:
    """The file with the weights to start from, downloaded if it must be; None to start at random."""
    if pretrained == "":
        return None
    if not pretrained:
        log.info("%s is built without pretrained weights", name)
        return None
    if isinstance(pretrained, str) and pretrained != "auto":
        path = Path(pretrained)
        if not path.is_file():
            raise ValueError(
                f"model.image.pretrained is true, false, auto or a weights file, and there is no file {path}"
            )
        return path
    try:
        if repository is None:
            raise OSError("timm names none")
        return fetch(repository, WEIGHTS) / WEIGHTS
    except OSError as error:
        if pretrained is True:
            raise ValueError(
                f"the weights of {name} cannot be fetched ({error}): give model.image.pretrained the path of a weights "
                "file, or false to start at random"
            ) from error
        log.warning("%s starts at RANDOM: its weights cannot be fetched (%s)", name, error)
        return None


def _read(path: Path, classifier: str | tuple[str, ...] | None) -> dict[str, Any]:
    """The weights in a file, without those of the classifier; nothing but tensors is read of a pickle."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        safe = path.suffix == ".safetensors"
        content = load_file(path) if safe else torch.load(path, map_location="cpu", weights_only=True)
    except (SafetensorError, UnpicklingError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path} cannot be read as weights, it is damaged or something else") from error
    names = (classifier,) if isinstance(classifier, str) else classifier or ()
    unwanted = tuple(f"{name}." for name in names)
    weights = {key: value for key, value in content.items() if not key.startswith(unwanted)}
    if not weights:
        raise ValueError(f"{path} holds no weights")
    return weights


def _output_channels(block: nn.Module) -> int:
    return [module for module in block.modules() if isinstance(module, nn.Conv2d)][-1].out_channels
