"""The axis about what is said."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.tasks.bound import BoundScene


class Phrasing:
    """How often an evaluation says something that training never hears."""

    def __init__(self, held_out: float) -> None:
        """Args: share of the episodes of an evaluation, 0…1."""
        self.held_out = held_out

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Nothing to draw here: each episode draws whether, and then what."""
        scene.novelty = self.held_out
        return {"held_out": self.held_out}
