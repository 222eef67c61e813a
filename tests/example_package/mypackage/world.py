"""A point that moves to a target in a square, seen from above, and the expert that moves it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from vla.io.types import Count, NonNegative
from vla.spec import Array, Observation, Spec

REACHED = 0.05  # distance from the target [m]


class Square:
    """A square of 1 m with a point, which actions move, and a target, both drawn at random.

    Args:
        size: side of the image [px].
        steps: of an episode, at most.
    """

    def __init__(self, size: Count, steps: Count) -> None:
        self.spec = Spec(
            cameras=("above",),
            image_size=(size, size),
            state=("x", "y"),
            state_units=("m", "m"),
            action=("dx", "dy"),
            units=("m", "m"),
            low=(-0.1, -0.1),
            high=(0.1, 0.1),
            control_hz=10.0,
            truth=(("target", 2),),
        )
        self.task, self.milestones = "reach", frozenset[str]()
        self.done, self.outcome = False, "timeout"
        self.draws: dict[str, Any] = {}
        self._steps, self._blind = steps, False

    def reset(self, seed: int) -> Observation:
        """Draw point and target."""
        random = np.random.default_rng(seed)
        self._point, self._target = random.uniform(0, 1, (2, 2))
        self._taken, self.done, self.outcome = 0, False, "timeout"
        self.draws = {"target": self._target.tolist()}
        return self._look()

    def step(self, action: Array) -> Observation:
        """Move the point by (2,) dx, dy [m]."""
        self._point = np.clip(self._point + np.clip(action, self.spec.low, self.spec.high), 0, 1)
        self._taken += 1
        if np.linalg.norm(self._point - self._target) < REACHED:
            self.outcome = "success"
        self.done = self.outcome == "success" or self._taken == self._steps
        return self._look()

    @contextmanager
    def blind(self) -> Iterator[None]:
        """Within this context observations carry no images."""
        self._blind = True
        try:
            yield
        finally:
            self._blind = False

    def close(self) -> None:
        """Nothing to free."""

    def _look(self) -> Observation:
        return Observation(
            rgb={} if self._blind else {"above": self._image()},
            state=self._point.astype(np.float32),
            instruction="go to the red target",
            truth={"target": self._target.astype(np.float32)},
        )

    def _image(self) -> Array:
        """(H, W, 3) uint8: the target red, the point white."""
        height, width = self.spec.image_size
        image = np.zeros((height, width, 3), np.uint8)
        for place, colour in ((self._target, (255, 0, 0)), (self._point, (255, 255, 255))):
            column, row = (place * (width - 1, height - 1)).astype(int)
            image[row, column] = colour
        return image


class Straight:
    """An expert that goes straight to the target.

    Args:
        noise: standard deviation of what is added to every executed action [m].
        spec: bounds of the actions.
    """

    def __init__(self, noise: NonNegative, *, spec: Spec) -> None:
        self.info: dict[str, Any] = {}
        self._noise, self._low, self._high = noise, spec.low, spec.high

    def reset(self, instruction: str, seed: int) -> None:
        """Start the noise over."""
        self._random = np.random.default_rng([seed, 1])

    def act(self, observation: Observation) -> Array:
        """As far towards the target as one step goes."""
        assert observation.truth is not None
        way = np.clip(observation.truth["target"] - observation.state, self._low, self._high)
        self.info = {"clean": way.astype(np.float32)}  # what is to be imitated
        return (way + self._random.normal(0, self._noise, 2)).astype(np.float32)
