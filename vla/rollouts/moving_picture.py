"""Moving pictures of episodes: animated WebP files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from vla.io.files import atomic_path
from vla.spec import Episode, Observation

FRAMES, HEIGHT = 48, 160  # at most; the height of a frame in pixels
MILLISECONDS, LAST_MILLISECONDS = 100, 1000  # of a frame, and of the last one
QUALITY, EFFORT = 60, 2  # of the compression
LARGEST = 4 << 20  # [bytes] of a file


def save_moving_picture(episode: Episode, path: Path) -> None:
    """Write an episode as an animated WebP, its cameras side by side; without images write nothing.

    Long episodes play faster, so that every picture takes about five seconds.
    """
    seen = [each for each in episode.observations if each.rgb]
    if not seen:
        return
    places = np.linspace(0, len(seen) - 1, min(FRAMES, len(seen))).round().astype(int)
    first, *others = (_frame(seen[int(place)]) for place in places)
    duration = [*[MILLISECONDS] * len(others), LAST_MILLISECONDS]
    options = {"save_all": True, "append_images": others, "loop": 0, "quality": QUALITY, "method": EFFORT}
    with atomic_path(path) as draft:
        first.save(draft, "WEBP", duration=duration, **options)


def _frame(seen: Observation) -> Image.Image:
    """Return the images (H, W, 3) of all cameras side by side, at most `HEIGHT` high."""
    frame = Image.fromarray(np.concatenate([*seen.rgb.values()], axis=1))
    frame.thumbnail((frame.width, HEIGHT))
    return frame
