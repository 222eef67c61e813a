"""Moving pictures of episodes: animated WebP files that also tell seed, outcome, instruction and events."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from vla.io.documents import STRICT, parse_json
from vla.io.errors import UserError
from vla.io.files import atomic_path, require_file
from vla.spec import Episode, Observation

FRAMES, HEIGHT = 48, 160  # at most; the height of a frame in pixels
MILLISECONDS, LAST_MILLISECONDS = 100, 1000  # of a frame, and of the last one
QUALITY, EFFORT = 60, 2  # of the compression
DESCRIPTION = 0x010E  # EXIF tag
LARGEST = 4 << 20  # [bytes] of a file


@dataclass(frozen=True)
class Caption:
    """What a moving picture shows."""

    __pydantic_config__ = STRICT

    seed: int
    outcome: str
    instruction: str  # several, given one after the other, are joined
    steps: int  # of the episode
    events: tuple[tuple[int, str], ...]  # step and description of what happened without the agent


def save_moving_picture(episode: Episode, events: Sequence[tuple[int, str]], path: Path) -> None:
    """Write an episode as an animated WebP, its cameras side by side; without images write nothing.

    Long episodes play faster, so that every picture takes about five seconds.
    """
    seen = [each for each in episode.observations if each.rgb]
    if not seen:
        return
    places = np.linspace(0, len(seen) - 1, min(FRAMES, len(seen))).round().astype(int)
    first, *others = (_frame(seen[int(place)]) for place in places)
    said = [each.instruction for each in episode.observations]
    given = [text for before, text in zip([None, *said], said, strict=False) if text != before]
    caption = Caption(episode.seed, episode.outcome, "; then ".join(given), len(said), tuple(events))
    exif = Image.Exif()
    exif[DESCRIPTION] = json.dumps(asdict(caption))  # ASCII, as EXIF demands
    with atomic_path(path) as draft:
        first.save(
            draft,
            "WEBP",
            save_all=True,
            append_images=others,
            duration=[*[MILLISECONDS] * len(others), LAST_MILLISECONDS],
            loop=0,
            quality=QUALITY,
            method=EFFORT,
            exif=exif,
        )


def read_moving_pictures(folder: Path) -> dict[Caption, Path]:
    """Return caption → file of the moving pictures in a folder.

    Raises:
        UserError: one is damaged, or of another program.
    """
    return {_caption(path): path for path in sorted(folder.glob("*.webp"))}


def _caption(path: Path) -> Caption:
    require_file(path)
    try:
        if path.stat().st_size > LARGEST:
            raise UserError(f"it is larger than {LARGEST} bytes")
        with Image.open(path, formats=["WEBP"]) as picture:
            return parse_json(str(picture.getexif()[DESCRIPTION]), Caption, "its caption")
    except (OSError, KeyError, ValueError) as error:
        raise UserError(f"{path} cannot be read: remove it to write the page without it: {error}") from error


def _frame(seen: Observation) -> Image.Image:
    """Return the images (H, W, 3) of all cameras side by side, at the height of the first, at most `HEIGHT`."""
    images = [Image.fromarray(np.asarray(image)) for image in seen.rgb.values()]
    height = min(images[0].height, HEIGHT)
    scaled = [image.resize((round(image.width * height / image.height), height)) for image in images]
    frame = Image.new("RGB", (sum(image.width for image in scaled), height))
    left = 0
    for image in scaled:
        frame.paste(image, (left, 0))
        left += image.width
    return frame
