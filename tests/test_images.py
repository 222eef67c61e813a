"""Images of any size in the size of training: what is used of them, how smooth it is, and what is left alone."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from vla.io.images import Crop, describe_resize, resize

RANDOM = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)


@pytest.mark.parametrize("crop", get_args(Crop))
def test_an_image_of_the_size_of_training_is_left_alone(crop: Crop) -> None:
    assert resize(RANDOM, (96, 96), crop) is RANDOM and describe_resize(RANDOM.shape, (96, 96), crop) == ""


def test_the_centre_is_used_or_all_is_squeezed() -> None:
    wide = np.zeros((480, 640, 3), np.uint8)
    wide[:, :80, 0], wide[:, 80:560, 1], wide[:, 560:, 2] = 255, 255, 255  # red and blue at the sides
    centre, whole = resize(wide, (96, 96), "centre"), resize(wide, (96, 96), "none")
    assert centre.shape == whole.shape == (96, 96, 3) and centre.dtype == np.uint8 and centre.flags.writeable
    assert (centre == (0, 255, 0)).all()
    assert (whole[:, 0] == (255, 0, 0)).all() and (whole[:, -1] == (0, 0, 255)).all()
    np.testing.assert_array_equal(resize(wide.transpose(1, 0, 2), (96, 96), "none"), whole.transpose(1, 0, 2))
    assert describe_resize(wide.shape, (96, 96), "centre") == (
        "images of 640 by 480 pixels are cropped at the centre to 480 by 480 and resized to 96 by 96"
    )
    assert describe_resize(wide.shape, (96, 96), "none") == "images of 640 by 480 pixels are resized to 96 by 96"


def test_every_pixel_counts() -> None:
    """Pixels that a small image leaves out would flicker where an edge moves."""
    stripes = np.zeros((960, 960, 3), np.uint8)
    stripes[:, ::2] = 255
    assert np.abs(resize(stripes, (96, 96), "centre") - 127.5).max() < 3
    repeated = RANDOM.repeat(10, 0).repeat(10, 1)
    assert np.abs(resize(repeated, (96, 96), "centre").astype(float).mean() - RANDOM.mean()) < 1


@pytest.mark.parametrize("shape", [(1, 1), (1, 4000), (8, 8), (97, 95)])
def test_any_size_is_taken(shape: tuple[int, int]) -> None:
    grey = np.full((*shape, 3), 77, np.uint8)
    for crop in get_args(Crop):
        assert (resize(grey, (96, 96), crop) == np.full((96, 96, 3), 77)).all()
