"""Statistics and a sample of the actions of an episode store.

Shapes: N steps, E episodes, D action components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vla.data.index import Entry
from vla.spec import Array

SAMPLE = 2**18  # largest number of actions in a sample


@dataclass(frozen=True)
class Statistics:
    """Moments of the actions over all stored steps, each (D,) float64, and the source of a sample."""

    low: Array
    high: Array
    mean: Array
    std: Array
    steps: int  # N
    actions: Array  # (N, D) float32, memory-mapped
    ends: Array  # (E,) the row after the last of every episode

    def chunks(self, length: int) -> Array:
        """Return chunks of actions, (M, length, D) float32, that start at evenly spaced steps, or at every step if few.

        Beyond the end of an episode its last action is repeated, as in training windows.
        """
        count = min(self.steps, max(SAMPLE // length, 1))
        rows = np.linspace(0, self.steps - 1, count).round().astype(np.int64)
        last = self.ends[self.ends.searchsorted(rows, side="right")] - 1
        return self.actions[np.minimum(rows[:, None] + np.arange(length), last[:, None])]


def statistics_of(entries: Sequence[Entry], actions: Array) -> Statistics:
    """Compute the statistics of the (N, D) actions of the episodes `entries`."""
    ends = np.array([entry.end for entry in entries])
    shown = actions[: ends[-1]]
    total, squares = np.zeros((2, shown.shape[1]))
    for entry in entries:  # episode by episode: all of them in double precision might not fit into memory
        wide = shown[entry.span].astype(np.float64)
        total += wide.sum(0)
        squares += (wide**2).sum(0)
    mean = total / len(shown)
    return Statistics(
        low=shown.min(0).astype(np.float64),
        high=shown.max(0).astype(np.float64),
        mean=mean,
        std=np.sqrt(np.maximum(squares / len(shown) - mean**2, 0)),
        steps=len(shown),
        actions=actions,
        ends=ends,
    )
