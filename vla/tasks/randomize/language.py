"""The axes about what is said."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.tasks.bound import BoundScene
from vla.types import Natural, Share


class Phrasing:
    """How often an evaluation says something that training never hears."""

    def __init__(self, held_out: Share) -> None:
        """Args: share of the episodes of an evaluation, 0…1."""
        self.held_out = held_out

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Nothing to draw here: each episode draws whether, and then what."""
        scene.novelty = self.held_out
        return {"held_out": self.held_out}


class Naming:
    """Which block the instruction names: in the same scene, another one than it would name without this axis."""

    def __init__(self, passed_over: Natural) -> None:
        """Args: how many blocks are passed over, in the order in which they would be named."""
        self.passed_over = passed_over

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Nothing to draw here."""
        scene.passed_over = self.passed_over
        return {"passed_over": self.passed_over}
