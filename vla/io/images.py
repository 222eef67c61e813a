"""Resizing of camera images to the size that a policy was trained with.

Shapes: H by W pixels.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from PIL import Image

Array = np.ndarray

Crop = Literal["centre", "none"]


def resize(image: Array, size: tuple[int, int], crop: Crop) -> Array:
    """Resize an (H, W, 3) uint8 image to `size` (height, width); an image of that size is returned as is.

    "centre" first crops to the largest centred part with the aspect ratio of `size`; "none" distorts the whole image.
    The interpolation is bilinear and antialiased.
    """
    if image.shape[:2] == size:
        return image
    rows, columns = _crop_region(image.shape, size, crop)
    cropped = Image.fromarray(image[rows, columns])
    # Reduce very large images by an integer factor first, which is faster and hardly differs.
    return np.array(cropped.resize((size[1], size[0]), Image.Resampling.BILINEAR, reducing_gap=3.0))


def describe_resize(shape: tuple[int, ...], size: tuple[int, int], crop: Crop) -> str:
    """Describe what `resize` does to images (H, W, …); empty if they have that size already."""
    if shape[:2] == size:
        return ""
    rows, columns = _crop_region(shape, size, crop)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    crop_text = f"cropped at the centre to {width} by {height} and " if (height, width) != shape[:2] else ""
    return f"images of {shape[1]} by {shape[0]} pixels are {crop_text}resized to {size[1]} by {size[0]}"


def _crop_region(shape: tuple[int, ...], size: tuple[int, int], crop: Crop) -> tuple[slice, slice]:
    """Rows and columns of an image (H, W, …) that are kept."""
    height, width = shape[:2]
    if crop == "none":
        return slice(0, height), slice(0, width)
    scale = min(height / size[0], width / size[1])
    rows, columns = max(round(scale * size[0]), 1), max(round(scale * size[1]), 1)
    top, left = (height - rows) // 2, (width - columns) // 2
    return slice(top, top + rows), slice(left, left + columns)
