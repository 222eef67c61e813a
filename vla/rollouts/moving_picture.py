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
MAX_BYTES = 4 << 20  # [bytes] of a file


def save_moving_picture(episode: Episode, path: Path) -> None:
    """Write an episode as an animated WebP, its cameras side by side.

    Long episodes play faster, so that every picture takes about five seconds.
    """
    observations = episode.observations
    indices = np.linspace(0, len(observations) - 1, min(FRAMES, len(observations))).round().astype(int)
    first_frame, *frames = (_frame(observations[int(index)]) for index in indices)
    duration = [*[MILLISECONDS] * len(frames), LAST_MILLISECONDS]
    options = {"save_all": True, "append_images": frames, "loop": 0, "quality": QUALITY, "method": EFFORT}
    with atomic_path(path) as draft:
        first_frame.save(draft, "WEBP", duration=duration, **options)


def _frame(observation: Observation) -> Image.Image:
    """Return the images (H, W, 3) of all cameras side by side, at most `HEIGHT` high."""
    frame = Image.fromarray(np.concatenate([*observation.rgb.values()], axis=1))
    frame.thumbnail((frame.width, HEIGHT))
    return frame
