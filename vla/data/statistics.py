"""Statistics of the actions of an episode store, and a sample of them.

Shapes: N steps, E episodes, D action components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vla.data.index import Entry
from vla.spec import Array

SAMPLE = 2**18  # actions that a sample has at most, whatever the size of the store


@dataclass(frozen=True)
class Statistics:
    """Moments of the actions over all stored steps, each (D,) float64, and where to take a sample from."""

    low: Array
    high: Array
    mean: Array
    std: Array
    steps: int  # N
    actions: Array  # (N, D) float32, memory-mapped
    ends: Array  # (E,) the row after the last of every episode

    def chunks(self, length: int) -> Array:
        """(M, length, D) float32: the actions from evenly spaced steps on, or from every step if they are few.

        Beyond the end of an episode its last action is repeated, as in the windows that are trained on.
        """
        count = min(self.steps, max(SAMPLE // length, 1))
        rows = np.linspace(0, self.steps - 1, count).round().astype(np.int64)
        last = self.ends[self.ends.searchsorted(rows, side="right")] - 1
        sample: Array = self.actions[np.minimum(rows[:, None] + np.arange(length), last[:, None])]
        return sample


def statistics_of(entries: Sequence[Entry], actions: Array) -> Statistics:
    """The statistics of the (N, D) actions of stored episodes, which are as `entries` say."""
    ends = np.array([entry.start + entry.steps for entry in entries])
    shown = actions[: ends[-1]]
    total, squares = np.zeros((2, shown.shape[1]))
    for entry in entries:  # one after the other: in double precision, all at once might not fit into memory
        wide = shown[entry.start : entry.start + entry.steps].astype(np.float64)
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
