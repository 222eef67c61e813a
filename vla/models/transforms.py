"""What happens between an observation and a model, the same in training, evaluation, serving and on a robot.

Shapes: B batch, T frames, H by W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch.nn.functional as F
from torch import Tensor

from vla.models.layers import Batch

Fit = Literal["crop", "pad", "stretch"]


@dataclass(frozen=True)
class Resize:
    """Images of any size and aspect ratio → images of one size, bilinear and antialiased, on the device of the images.

    Args:
        size: height and width [px].
        fit: for another aspect ratio, "crop" to the centre, "pad" with black borders, or "stretch".
    """

    size: tuple[int, int]
    fit: Fit

    def __call__(self, images: Tensor) -> Tensor:
        """Resize (B, T, H, W, 3) uint8 images; those of the size are returned as they are."""
        (height, width), shape = self.size, images.shape[2:4]
        if tuple(shape) == self.size:
            return images
        x = images.flatten(0, 1).permute(0, 3, 1, 2)
        rows, columns = height, width  # of the result that show the images
        if self.fit == "crop":
            scale = min(shape[0] / height, shape[1] / width)
            kept = max(round(scale * height), 1), max(round(scale * width), 1)
            top, left = ((whole - part) // 2 for whole, part in zip(shape, kept, strict=True))
            x = x[:, :, top : top + kept[0], left : left + kept[1]]
        elif self.fit == "pad":
            scale = min(height / shape[0], width / shape[1])
            rows, columns = max(round(scale * shape[0]), 1), max(round(scale * shape[1]), 1)
        if images.is_cuda:  # where torch interpolates no integers
            x = F.interpolate(x.float(), (rows, columns), mode="bilinear", antialias=True).round_().clamp_(0, 255)
        else:
            x = F.interpolate(x, (rows, columns), mode="bilinear", antialias=True)
        top, left = (height - rows) // 2, (width - columns) // 2
        x = F.pad(x, (left, width - columns - left, top, height - rows - top))
        return x.to(images.dtype).permute(0, 2, 3, 1).unflatten(0, images.shape[:2]).contiguous()


@dataclass(frozen=True)
class Transforms:
    """The list of steps, which a policy has in its configuration as `model.image_size` and `model.fit`.

    Images are brought to the size of the demonstrations first, so that a sharper camera shows no more than training
    did. Numbers are normalised within the model, by statistics that are saved with its weights, and absent frames of a
    window are zero.

    Args:
        images: steps on the images of every camera.
        tokenize: sentences → tokens.
    """

    images: tuple[Resize, ...]
    tokenize: Callable[[list[str]], Tensor]

    def __call__(self, batch: Batch) -> Batch:
        """Return the input of a model: its images have `image_size`, and "text" is there, made of "instruction"."""
        rgb = dict(batch["rgb"])
        for step in self.images:
            rgb = {camera: step(values) for camera, values in rgb.items()}
        text = batch["text"] if "text" in batch else self.tokenize(batch["instruction"]).to(batch["state"].device)
        return {**batch, "rgb": rgb, "text": text}
