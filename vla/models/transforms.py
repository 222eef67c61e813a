"""What happens between an observation and a model, the same in training, evaluation, serving and on a robot.

Shapes: B batch, T frames, H by W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from vla.io.images import Fit, fitted
from vla.models.layers import Batch


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
        if tuple(images.shape[2:4]) == self.size:
            return images
        return fitted(images.flatten(0, 1), self.size, self.fit).unflatten(0, images.shape[:2])


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
