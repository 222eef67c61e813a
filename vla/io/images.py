"""Camera images: decoding of untrusted files, and one resizing rule for policies and importers.

Shapes: N images, H by W pixels.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Literal

import numpy as np
from PIL import Image, UnidentifiedImageError

from vla.io.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

Array = np.ndarray

FORMATS = ("PNG", "JPEG", "WEBP")
MODES = ("RGB", "RGBA", "L", "LA", "P")  # of Pillow, with 8 bits per channel
MOST_PIXELS = 4096 * 4096  # of a file, whose header may promise any number

Fit = Literal["crop", "pad", "stretch"]  # for another aspect ratio: the centre, black borders, or distorted


def fit_images(images: Tensor, size: tuple[int, int], fit: Fit) -> Tensor:
    """Resize (N, …, H, W, 3) uint8 images to `size` (height, width), bilinear and antialiased, on their device.

    Images of that size are returned as they are.
    """
    (height, width), shape = size, images.shape[-3:-1]
    if shape == (height, width):
        return images
    import torch.nn.functional as F  # takes seconds

    x = images.flatten(0, -4).permute(0, 3, 1, 2)
    rows, columns = height, width  # of the result that show the images
    if fit == "crop":
        scale = min(shape[0] / height, shape[1] / width)
        crop = max(round(scale * height), 1), max(round(scale * width), 1)
        top, left = ((whole - part) // 2 for whole, part in zip(shape, crop, strict=True))
        x = x[:, :, top : top + crop[0], left : left + crop[1]]
    elif fit == "pad":
        scale = min(height / shape[0], width / shape[1])
        rows, columns = max(round(scale * shape[0]), 1), max(round(scale * shape[1]), 1)
    if images.is_cuda:  # where torch interpolates no integers
        x = F.interpolate(x.float(), (rows, columns), mode="bilinear", antialias=True).round_().clamp_(0, 255)
    else:
        x = F.interpolate(x, (rows, columns), mode="bilinear", antialias=True)
    top, left = (height - rows) // 2, (width - columns) // 2
    x = F.pad(x, (left, width - columns - left, top, height - rows - top))
    return x.to(images.dtype).permute(0, 2, 3, 1).contiguous().unflatten(0, images.shape[:-3])


def resize(image: Array, size: tuple[int, int]) -> Array:
    """Crop an (H, W, 3) uint8 image to the centre and resize it; one of that size is returned as it is."""
    if image.shape[:2] == tuple(size):
        return image
    import torch

    return fit_images(torch.tensor(image)[None], size, "crop")[0].numpy()


def decode_image(content: bytes, size: tuple[int, int] | None = None) -> Array:
    """Decode the content of an image file, (H, W, 3) uint8; grey becomes equal colours, transparency is dropped.

    A UserError if it is damaged, of another kind, or its header has another `size` (height, width), or too many pixels.
    """
    try:
        with Image.open(io.BytesIO(content), formats=FORMATS) as image:
            height, width = image.height, image.width
            expected_size = size or (height, width)
            if image.mode not in MODES or (height, width) != expected_size or height * width > MOST_PIXELS:
                limits = f"{f'{size[0]} x {size[1]}, ' if size else ''}at most {MOST_PIXELS}, of {', '.join(MODES)}"
                raise UserError(f"the image is {height} x {width} pixels of {image.mode}, and must be {limits}")
            return np.array(image.convert("RGB"))
    except UnidentifiedImageError as error:  # its text contains a memory address
        raise UserError(f"the image cannot be decoded: it is not {' or '.join(FORMATS)}") from error
    except UserError:
        raise
    except Exception as error:  # a damaged file can raise nearly anything
        raise UserError(f"the image cannot be decoded ({str(error)[:200]})") from error
