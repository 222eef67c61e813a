"""Newest image of every camera, with a check that their time stamps match.

All times are seconds on one monotonic clock.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla.spec import Array

MAX_SKEW = 0.05  # largest difference between the time stamps of one set of images [s]


class CameraSync:
    """The newest image of each camera; images within `MAX_SKEW` of each other form a matching set."""

    def __init__(self, cameras: Sequence[str]) -> None:
        """Args: the cameras of a set."""
        self.fresh = 0  # matching sets since the last reset to 0, each with a newer image of every camera
        self._cameras = tuple(cameras)
        self._newest: dict[str, tuple[float, Array]] = {}  # camera → time stamp and image
        self._counted: dict[str, float] = {}  # camera → time stamp of its image in the last counted set
        self._matched_at = -np.inf  # newest time stamp in the last matching set

    def add(self, camera: str, image: Array, at: float) -> None:
        """Add an image (H, W, 3) uint8 that was taken at `at`."""
        self._newest[camera] = (at, image)
        if self.taken_at is None:
            return
        times = {name: self._newest[name][0] for name in self._cameras}
        self._matched_at = max(times.values())
        if all(taken > self._counted.get(name, -np.inf) for name, taken in times.items()):
            self.fresh, self._counted = self.fresh + 1, times

    @property
    def taken_at(self) -> float | None:
        """Oldest time stamp of the newest images; None if these do not form a matching set."""
        if any(camera not in self._newest for camera in self._cameras):
            return None
        times = [self._newest[camera][0] for camera in self._cameras]
        return min(times) if max(times) - min(times) <= MAX_SKEW else None

    @property
    def images(self) -> dict[str, Array]:
        """Camera → its newest image."""
        return {camera: self._newest[camera][1] for camera in self._cameras}

    def problem(self, now: float, max_age: float) -> str:
        """Describe what is missing, older than `max_age` [s] or has not matched for so long; empty if nothing is."""
        for camera in self._cameras:
            if camera not in self._newest:
                return f"no image of the camera {camera} yet"
            if now - self._newest[camera][0] > max_age:
                return f"the newest image of the camera {camera} is older than {max_age} s"
        if now - self._matched_at > max_age:
            return f"the images of {', '.join(self._cameras)} are more than {MAX_SKEW} s apart"
        return ""
