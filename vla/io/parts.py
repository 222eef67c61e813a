"""Images that are parts of a larger picture, and can be cut out of it wherever the picture and the state are known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, MaxLen, MinLen, Predicate
from PIL import Image

from vla.io.documents import STRICT
from vla.io.errors import UserError
from vla.io.types import names_a_file

Array = np.ndarray

PICTURE = "picture"  # in place of a camera: the whole picture
FULL_WINDOW = (0.0, 0.0, 1.0, 1.0)  # window of all of it: top, left, bottom, right

Name = Annotated[str, MinLen(1), MaxLen(100)]
Camera = Annotated[Name, Predicate(names_a_file)]


@dataclass(frozen=True)
class Part:
    """The part of a picture that a camera shows: a fixed one, or one around a point of the robot.

    A window is top, left, bottom and right, as shares of the picture's height and width.
    """

    __pydantic_config__ = STRICT

    camera: Camera
    window: Annotated[tuple[float, ...], MinLen(4), MaxLen(4)] = FULL_WINDOW  # of a moving part: relative to its centre
    point: Annotated[tuple[Name, ...], MaxLen(3)] = ()  # (3,) state components of a position [m]; empty: it is fixed
    offset: Annotated[tuple[float, ...], MaxLen(3)] = ()  # (3,) from that position to the centre of the part [m]
    # (12,) rows of a matrix: the centre's (x, y, z, 1) → depth times (down, across, 1), as shares of the picture.
    projection: Annotated[tuple[float, ...], MaxLen(12)] = ()
    pixels: Annotated[int, Ge(1), Le(4096)] = 1  # a moving part moves in steps of 1 / pixels of the picture

    def window_at(self, place: Array) -> Array:
        """Return the window (4,), within the picture, with the point at `place` (3,) [m]."""
        window = np.array(self.window)
        if not self.point:
            return window
        down, across, depth = np.reshape(self.projection, (3, 4)) @ (*(place + self.offset), 1.0)
        corner = np.array([down, across]) / max(depth, 1e-6) + window[:2]
        size = window[2:] - window[:2]
        corner = (np.rint(self.pixels * corner) / self.pixels).clip(0, 1 - size)
        return np.concatenate([corner, corner + size])

    def picture_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return height and width [px] of the smallest picture in which the part has at least `size` pixels."""
        top, left, bottom, right = self.window
        return max(self.pixels, ceil(size[0] / (bottom - top))), max(self.pixels, ceil(size[1] / (right - left)))

    def problems(self, cameras: Sequence[str], state: Sequence[str]) -> Iterator[str]:
        """Yield what contradicts itself, or the cameras and the state of a spec."""
        top, left, bottom, right = self.window
        if self.camera not in cameras:
            yield f"parts names {self.camera}, which is not among the cameras"
        if not (0 < bottom - top <= 1 and 0 < right - left <= 1) or (not self.point and min(top, left) < 0):
            yield f"the window of {self.camera} is {self.window}, not top, left, bottom and right within the picture"
        if not self.point and max(bottom, right) > 1:
            yield f"the window of {self.camera} ends outside the picture"
        if unknown_names := [name for name in self.point if name not in state]:
            yield f"the part of {self.camera} moves with {', '.join(unknown_names)}, which is not in the state"
        if (len(self.point), len(self.offset), len(self.projection)) not in ((0, 0, 0), (3, 3, 12)):
            yield f"the part of {self.camera} needs 3 names in point, 3 numbers in offset, 12 in projection, or none"


def cut(picture: Array, window: Sequence[float] | Array, size: tuple[int, int]) -> Array:
    """Return a window of a picture, averaged over areas to a size (height, width) [px].

    Raises a UserError if the picture is not (H, W, 3) uint8.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise UserError(f'the image "{PICTURE}" must be (H, W, 3) uint8, and is {picture.dtype} of {picture.shape}')
    height, width = picture.shape[:2]
    top, left, bottom, right = np.array(window) * (height, width, height, width)
    image = Image.fromarray(picture).resize(size[::-1], Image.Resampling.BOX, (left, top, right, bottom))
    return np.asarray(image)


def with_parts(
    images: Mapping[str, Array], state: Mapping[str, float], parts: Sequence[Part], size: tuple[int, int]
) -> Mapping[str, Array]:
    """Add the images, (*size, 3), of the parts that `images` lacks, cut out of the whole picture.

    `images` are camera → (H, W, 3) uint8, with `PICTURE`; `state` is component → value; `size` is height, width [px].
    """
    all_images = dict(images)
    for part in parts:
        if part.camera not in images:
            place = np.array([state[name] for name in part.point], np.float64)
            all_images[part.camera] = cut(images[PICTURE], part.window_at(place), size)
    return all_images
