"""Image encoders with pretrained timm backbones.

Shapes: N images, C channels, H by W pixels, h by w positions of a feature map.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.documents import lines_of
from vla.io.errors import UserError, suggestion
from vla.io.types import Pixels, Width
from vla.models.hub import fetch
from vla.models.packaged import PackagedFile
from vla.models.trunk import Source
from vla.models.vision.image_tokenizer import FiLM, ImageEncoder

log = logging.getLogger(__name__)

WEIGHTS = "model.safetensors"  # file name of timm's weights on the hub
PretrainedSource = bool | str | PackagedFile


def synchronize_batch_norm(model: nn.Module) -> nn.Module:
    """Convert batch normalisation to synchronised batch normalisation, and keep the activations in timm's layers."""
    from timm.layers import convert_sync_batchnorm

    return convert_sync_batchnorm(model)


class _Normalize(nn.Module):
    """Input normalisation of a timm network.

    Args:
        backbone: the network.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, backbone: Any) -> None:
        super().__init__()
        for name in ("mean", "std"):
            self.register_buffer(name, torch.tensor(backbone.pretrained_cfg[name]).view(3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Normalise (N, 3, H, W) images in 0 … 1 to about zero mean and unit variance."""
        return (images - self.mean) / self.std


class FilmEfficientNet(ImageEncoder):
    """An EfficientNet with FiLM after every block and after its final projection, as in RT-1 (arXiv 2212.06817).

    Every FiLM is initialised as the identity, so the initial features are those of the EfficientNet.

    Args:
        name: an EfficientNet of timm.
        pretrained: true downloads timm's weights or fails; false initialises at random; "auto" downloads them or
            initialises at random with a warning; another text is the path of a weights file (.safetensors or .pth),
            which may also lie in a Python package.
        channels: C of the feature map.
        text_width: length of the text vector.
    """

    def __init__(self, name: str, pretrained: PretrainedSource, channels: Width, *, text_width: int) -> None:
        super().__init__(channels)
        net = load_backbone(name, pretrained)
        if not hasattr(net, "conv_stem"):
            raise UserError(f"model.image.name={name} is no EfficientNet: model/image=timm takes any network of timm")
        self.normalize = _Normalize(net)
        self.stem = nn.Sequential(net.conv_stem, net.bn1)
        self.blocks = nn.ModuleList(block for stage in net.blocks for block in stage)
        self.films = nn.ModuleList(FiLM(text_width, _output_channels(b), identity=True) for b in self.blocks)
        self.top = nn.Sequential(net.conv_head, net.bn2)
        self.projection = nn.Conv2d(net.conv_head.out_channels, channels, 1, bias=False)
        self.last_film = FiLM(text_width, channels, identity=True)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """Encode (N, 3, H, W) float images in 0 … 1 with (N, text_width) text as (N, channels, h, w)."""
        x = self.stem(self.normalize(images))
        for block, film in zip(self.blocks, self.films, strict=True):
            x = film(block(x), text)
        return self.last_film(self.projection(self.top(x)), text)


class FilmBackbone(ImageEncoder):
    """Projected last feature map of any timm network, such as DINO or SigLIP, with FiLM.

    The feature map of a vision transformer is its normalised patch tokens. FiLM is initialised as the identity.

    Args:
        name: a timm network, with or without the tag of its weights.
        pretrained: as in `FilmEfficientNet`.
        frozen: train only projection and FiLM.
        size: images are resized to this height and width [px]; null is the training resolution of the network.
        channels: C of the feature map.
        text_width: length of the text vector.

    Raises:
        UserError: timm has no such network, the size is unsupported, or the weights are not available.
    """

    def __init__(
        self,
        name: str,
        pretrained: PretrainedSource,
        frozen: bool,
        size: Pixels | None,
        channels: Width,
        *,
        text_width: int,
    ) -> None:
        super().__init__(channels)
        self.backbone = load_backbone(name, pretrained, size=size)
        self.backbone.prune_intermediate_layers(1, prune_norm=False, prune_head=True)
        stage = self.backbone.feature_info[-1]
        if size is not None and size % stage["reduction"]:
            raise UserError(f"model.image.size={size} must be a multiple of {stage['reduction']} px for {name}")
        self.size = size or self.backbone.pretrained_cfg["input_size"][-1]
        self.frozen = frozen
        self.normalized = "hiera" not in name  # the only family without a normalisation of feature maps
        self.backbone.requires_grad_(not frozen).train(not frozen)  # Lightning keeps the mode that it finds
        self.normalize = _Normalize(self.backbone)
        self.projection = nn.Conv2d(stage.get("num_chs_norm", stage["num_chs"]), channels, 1, bias=False)
        self.film = FiLM(text_width, channels, identity=True)

    def train(self, mode: bool = True) -> FilmBackbone:
        """Set the training mode; a frozen backbone stays in evaluation mode."""
        super().train(mode)
        if self.frozen:
            self.backbone.eval()
        return self

    def forward(self, images: Tensor, text: Tensor) -> Tensor:
        """Encode (N, 3, H, W) float images in 0 … 1 with (N, text_width) text as (N, channels, h, w)."""
        x = F.interpolate(images, (self.size, self.size), mode="bilinear")
        (features,) = self.backbone.forward_intermediates(
            self.normalize(x), indices=1, norm=self.normalized, output_fmt="NCHW", intermediates_only=True
        )
        return self.film(self.projection(features), text)


def load_backbone(name: str, pretrained: PretrainedSource, size: int | None = None) -> Any:
    """Create a timm network without its classifier; `pretrained` as in `FilmEfficientNet`.

    Args:
        size: height and width of the images [px], for networks with a fixed input size.

    Raises:
        UserError: timm has no such network, or the weights are not available.
    """
    import timm  # slow to import, not needed by every policy

    names = [*timm.list_models(), *timm.list_pretrained()]
    if name not in names:
        raise UserError(f"model.image.name={name} is no network of timm{suggestion(name, names)}")
    config: Any = timm.get_pretrained_cfg(name)
    options: dict[str, Any] = {"num_classes": 0, "img_size": size if config.fixed_input_size else None}
    repository = config.hf_hub_id or f"timm/{name}"
    path = _weights_file(name, repository, pretrained)
    if path is None:
        return timm.create_model(name, **options)
    classifiers = (config.classifier,) if isinstance(config.classifier, str) else config.classifier or ()
    prefixes = tuple(f"{classifier}." for classifier in classifiers)
    # Without a classifier in network and file, timm loads the weights strictly.
    weights = {key: value for key, value in _read_weights(path, name).items() if not key.startswith(prefixes)}
    overlay = {"state_dict": weights, "classifier": None, "num_classes": 0}
    try:
        net: Any = timm.create_model(name, pretrained=True, pretrained_cfg_overlay=overlay, **options)
    except RuntimeError as error:
        raise UserError(f"{path} does not hold the weights of timm's {name}: {lines_of(error)[-1]}") from error
    del net.pretrained_cfg["state_dict"]
    origin = pretrained if isinstance(pretrained, str) and pretrained != "auto" else repository
    net.source = Source.from_file(path, pretrained.source if isinstance(pretrained, PackagedFile) else origin)
    log.info("%s: weights loaded from %s", name, path)
    return net


def _weights_file(name: str, repository: str, pretrained: PretrainedSource) -> Path | None:
    """Return the file of the initial weights, downloaded if necessary; None for random initialisation."""
    if isinstance(pretrained, PackagedFile):
        path = pretrained.locate(WEIGHTS)
        return path / WEIGHTS if path.is_dir() else path
    if not pretrained:
        return None
    if isinstance(pretrained, str) and pretrained != "auto":
        if not Path(pretrained).is_file():
            raise UserError(
                f"model.image.pretrained is true, false, auto or a weights file, and there is no file {pretrained}"
            )
        return Path(pretrained)
    advice = "model.image.pretrained may also be the path of a weights file, or false to start at random"
    try:
        return fetch(repository, WEIGHTS, advice=advice) / WEIGHTS
    except UserError as error:
        if pretrained is True:
            raise
        log.warning("%s starts with RANDOM weights: %s", name, error)
        return None


def _read_weights(path: Path, name: str) -> dict[str, Tensor]:
    """Read the weights of the network `name`; of a pickle only tensors are read.

    Weights of efficientnet_pytorch get timm's names: both packages register their layers in the order of execution, so
    the tensors stand in the same order. If their shapes disagree, timm refuses them.
    """
    import timm

    try:
        weights: dict[str, Tensor] = timm.models.load_state_dict(str(path), use_ema=False, weights_only=True)
        if not weights or not all(isinstance(weight, Tensor) for weight in weights.values()):
            raise ValueError
    except Exception as error:  # a pickle can raise nearly anything
        raise UserError(f"{path} cannot be read as weights: it is damaged or of another kind") from error
    if "_conv_stem.weight" in weights:
        with torch.device("meta"):
            weights = dict(zip(timm.create_model(name).state_dict(), weights.values(), strict=False))
    return weights


def _output_channels(block: nn.Module) -> int:
    return [module for module in block.modules() if isinstance(module, nn.Conv2d)][-1].out_channels
