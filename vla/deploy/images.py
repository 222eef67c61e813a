"""Camera images of any size, in the size that a policy was trained on.

Shapes: H by W pixels.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from PIL import Image

from vla.spec import Array

Crop = Literal["centre", "none"]


def fitted(image: Array, size: tuple[int, int], crop: Crop) -> Array:
    """An (H, W, 3) uint8 image in another size (height, width); one that has it already is returned as it is.

    "centre" first cuts out the largest centred part that has the aspect ratio of `size`; "none" squeezes the whole
    image. Each pixel is a weighted mean of all those that it covers (bilinear, antialiased).
    """
    if image.shape[:2] == size:
        return image
    rows, columns = _used(image.shape, size, crop)
    used = Image.fromarray(image[rows, columns])
    # Far too large images are first made smaller by a whole factor, which is faster and hardly differs.
    return np.array(used.resize((size[1], size[0]), Image.Resampling.BILINEAR, reducing_gap=3.0))


def change(image: Array, size: tuple[int, int], crop: Crop) -> str:
    """What `fitted` does to an image (H, W, 3), in words; nothing where it has the size already."""
    if image.shape[:2] == size:
        return ""
    rows, columns = _used(image.shape, size, crop)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    cut = f"cropped at the centre to {width} by {height} and " if (height, width) != image.shape[:2] else ""
    return f"images of {image.shape[1]} by {image.shape[0]} pixels are {cut}resized to {size[1]} by {size[0]}"


def _used(shape: tuple[int, ...], size: tuple[int, int], crop: Crop) -> tuple[slice, slice]:
    """Rows and columns of an image (H, W, …) that are used."""
    height, width = shape[:2]
    if crop == "none":
        return slice(0, height), slice(0, width)
    scale = min(height / size[0], width / size[1])
    rows, columns = max(round(scale * size[0]), 1), max(round(scale * size[1]), 1)
    top, left = (height - rows) // 2, (width - columns) // 2
    return slice(top, top + rows), slice(left, left + columns)
