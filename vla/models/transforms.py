"""Preprocessing of observations for a model, the same in training, evaluation, serving and on a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from vla.io.images import Fit, fit_images
from vla.models.layers import Batch


@dataclass(frozen=True)
class Transforms:
    """The preprocessing of a batch, which the configuration of a policy sets by `model.image_size` and `model.fit`.

    Images are first resized to the size of the demonstrations, so that a sharper camera shows no more than in training.
    The model itself normalises numbers, by statistics saved with its weights. Absent frames of a window are zero.

    Args:
        demonstrations: height and width of their images, to which importers have cropped them [px].
        size: height and width of the images that the model sees [px].
        fit: how another aspect ratio becomes `size`: "crop" to the centre, "pad" with black borders, or "stretch".
        tokenize: sentences → tokens.
    """

    demonstrations: tuple[int, int]
    size: tuple[int, int]
    fit: Fit
    tokenize: Callable[[list[str]], Tensor]

    def __call__(self, batch: Batch) -> Batch:
        """Return the input of a model: its images have `image_size`, and "text" is there, made of "instruction"."""
        # Cropped regardless of `fit`, as by importers, which know no model, so that robots show what they stored.
        rgb = {camera: fit_images(images, self.demonstrations, "crop") for camera, images in batch["rgb"].items()}
        rgb = {camera: fit_images(images, self.size, self.fit) for camera, images in rgb.items()}
        text = batch["text"] if "text" in batch else self.tokenize(batch["instruction"]).to(batch["state"].device)
        return {**batch, "rgb": rgb, "text": text}
