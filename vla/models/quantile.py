"""Bins that hold as many actions of the data each.

Shapes: N actions, D action components, K bins, … any leading dimensions.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vla.models.action_tokenizer import PerComponent, Statistics, data_bounds
from vla.spec import Spec
from vla.types import Bins


class Quantile(PerComponent):
    """Bins between the quantiles of the data, component by component, read as the mean of the data in them.

    Small motions, of which there are many, get narrow bins, and large ones, of which there are few, wide bins. On the
    data they were fitted on they have no bias. A value that occurs often is not divided, so a component may use fewer
    than K bins: a gripper that only opens and closes uses two.

    Args:
        bins: K.
        spec: gives the range of allowed actions.
        statistics: the data; None before a checkpoint's bins are loaded, even ones over the allowed range stand in.
    """

    edges: Tensor  # (D, K - 1) between neighbouring bins, rising; those of unused bins lie beyond the bounds
    centres: Tensor  # (D, K) the actions that the tokens stand for

    def __init__(self, bins: Bins = 256, *, spec: Spec, statistics: Statistics | None = None) -> None:
        low, high = data_bounds(spec, statistics)
        super().__init__(spec, low, high, bins)
        sample = np.linspace(low, high, 2 * bins + 1) if statistics is None else statistics.chunks(1)[:, 0]
        fitted = [_bins(values, bins) for values in np.sort(np.asarray(sample, np.float64), axis=0).T]
        beyond = self.high + (self.high - self.low)
        self.register_buffer("edges", beyond[:, None].repeat(1, bins - 1))
        self.register_buffer("centres", self.high[:, None].repeat(1, bins))
        for index, (edges, centres) in enumerate(fitted):
            self.edges[index, : len(edges)] = torch.from_numpy(edges)
            self.centres[index, : len(centres)] = torch.from_numpy(centres)

    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions as the tokens of the bins that they lie in, (…, D) int64."""
        inside = torch.minimum(torch.maximum(action, self.low), self.high)
        columns = inside.reshape(-1, self.components).T.contiguous()  # (D, N)
        return torch.searchsorted(self.edges, columns, right=True).T.reshape(action.shape)

    def decode(self, token: Tensor) -> Tensor:
        """(…, D) tokens as the mean of the data in their bins, (…, D) float."""
        return self.centres[torch.arange(self.components, device=token.device), token]


def _bins(values: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges and means of as many bins, at most `bins`, as the (N,) rising `values` can be divided into."""
    starts = np.arange(1, bins) * len(values) // bins
    # Where the value begins that a bin would start with; and not on a value but midway to the one before, where what
    # rounding does to an edge or to an action changes nothing.
    first = np.unique(values.searchsorted(values[starts]))
    first = first[first > 0]
    edges = (values[first - 1] + values[first]) / 2
    return edges, np.array([part.mean() for part in np.split(values, first)])
