"""What the cameras show: their newest images, whether these belong together, and how many did since somebody asked.

All times are seconds on one clock that never stops.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla.spec import Array

TOGETHER = 0.05  # furthest that the images of all cameras may lie apart [s]


class Frames:
    """The newest image of each camera; a frame is one image of each, taken together."""

    def __init__(self, cameras: Sequence[str]) -> None:
        """Args: the cameras that belong to a frame."""
        self.fresh = 0  # frames since somebody set it to 0, each with a newer image of every camera than the last
        self._cameras = tuple(cameras)
        self._newest: dict[str, tuple[float, Array]] = {}  # camera → when its image was taken, and that
        self._counted: dict[str, float] = {}  # camera → when its image in the last frame that counted was taken
        self._together_at = -np.inf  # when the newest image was taken that belonged to a frame

    def see(self, camera: str, image: Array, at: float) -> None:
        """An image (H, W, 3) uint8 that was taken at `at`."""
        self._newest[camera] = (at, image)
        if self.taken_at is None:
            return
        times = {name: self._newest[name][0] for name in self._cameras}
        self._together_at = max(times.values())
        if all(taken > self._counted.get(name, -np.inf) for name, taken in times.items()):
            self.fresh, self._counted = self.fresh + 1, times

    @property
    def taken_at(self) -> float | None:
        """When the first image of the newest frame was taken; None while the newest images do not belong together."""
        if any(camera not in self._newest for camera in self._cameras):
            return None
        times = [self._newest[camera][0] for camera in self._cameras]
        return min(times) if max(times) - min(times) <= TOGETHER else None

    @property
    def images(self) -> dict[str, Array]:
        """Camera → its newest image."""
        return {camera: self._newest[camera][1] for camera in self._cameras}

    def late(self, now: float, age: float) -> str:
        """What is missing, older than `age` [s] or out of step for so long, in words; nothing where all is well."""
        for camera in self._cameras:
            if camera not in self._newest:
                return f"no image of the camera {camera} yet"
            if now - self._newest[camera][0] > age:
                return f"the newest image of the camera {camera} is older than {age} s"
        if now - self._together_at > age:
            return f"the images of {', '.join(self._cameras)} lie more than {TOGETHER} s apart"
        return ""
