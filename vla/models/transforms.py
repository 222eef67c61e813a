"""What happens between an observation and a model, the same in training, evaluation, serving and on a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from vla.io.images import Fit, fitted
from vla.models.layers import Batch


@dataclass(frozen=True)
class Transforms:
    """The steps, which a policy has in its configuration as `model.image_size` and `model.fit`.

    Images are brought to the size of the demonstrations first, so that a sharper camera shows no more than training
    did. The model itself normalises numbers, by statistics saved with its weights. Absent frames of a window are zero.

    Args:
        demonstrations: height and width of their images, to which importers have cropped them [px].
        size: those of the images that the model sees [px].
        fit: of these, for another aspect ratio: "crop" to the centre, "pad" with black borders, or "stretch".
        tokenize: sentences → tokens.
    """

    demonstrations: tuple[int, int]
    size: tuple[int, int]
    fit: Fit
    tokenize: Callable[[list[str]], Tensor]

    def __call__(self, batch: Batch) -> Batch:
        """Return the input of a model: its images have `image_size`, and "text" is there, made of "instruction"."""
        # Cropped whatever `fit` is, as importers do, who know no model: so a robot's camera shows what they stored.
        rgb = {camera: fitted(images, self.demonstrations, "crop") for camera, images in batch["rgb"].items()}
        rgb = {camera: fitted(images, self.size, self.fit) for camera, images in rgb.items()}
        text = batch["text"] if "text" in batch else self.tokenize(batch["instruction"]).to(batch["state"].device)
        return {**batch, "rgb": rgb, "text": text}
