"""Statistics and a sample of the actions of an episode store.

Shapes: N steps, E episodes, D action components.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vla.spec import Array

MAX_SAMPLE = 2**18  # largest number of actions in a sample


@dataclass(frozen=True)
class Statistics:
    """Bounds and a sample of the actions of all stored steps."""

    actions: Array  # (N, D) float32, memory-mapped
    ends: Array  # (E,) the row after the last of every episode

    @property
    def low(self) -> Array:
        """(D,) smallest values."""
        return self.actions.min(0)

    @property
    def high(self) -> Array:
        """(D,) largest values."""
        return self.actions.max(0)

    def chunks(self, length: int) -> Array:
        """Return chunks of actions, (M, length, D) float32, that start at evenly spaced steps, or at every step if few.

        Beyond the end of an episode its last action is repeated, as in training windows.
        """
        count = min(len(self.actions), max(MAX_SAMPLE // length, 1))
        rows = np.linspace(0, len(self.actions) - 1, count).round().astype(np.int64)
        last_rows = self.ends[self.ends.searchsorted(rows, side="right")] - 1
        return self.actions[np.minimum(rows[:, None] + np.arange(length), last_rows[:, None])]
