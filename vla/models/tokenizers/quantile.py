"""Quantile bins, which contain equally many actions of the data.

Shapes: N actions, D action components, K bins, … any leading dimensions.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vla.io.types import Bins
from vla.models.tokenizers.tokenizer import ComponentTokenizer, data_bounds
from vla.spec import ActionStatistics, Spec


class Quantile(ComponentTokenizer):
    """Bins between the quantiles of the data per component, decoded as the mean of the data in them.

    Small motions, which are frequent, get narrow bins, and large ones wide bins. There is no bias on the fitted data.
    Equal values share a bin, so a component may use fewer than K bins: a gripper that only opens and closes uses two.

    Args:
        bins: K.
        spec: gives the allowed range of actions.
        statistics: the data; None if a checkpoint is loaded next, uniform bins over the allowed range until then.
    """

    edges: Tensor  # (D, K - 1) between neighbouring bins, ascending; those of unused bins lie outside the bounds
    centres: Tensor  # (D, K) actions of the tokens

    def __init__(self, bins: Bins, *, spec: Spec, statistics: ActionStatistics | None = None) -> None:
        low, high = data_bounds(spec, statistics)
        super().__init__(spec, low, high, bins)
        sample = np.linspace(low, high, 2 * bins + 1) if statistics is None else statistics.chunks(1)[:, 0]
        edges_and_centres = [_bins(values, bins) for values in np.sort(np.asarray(sample, np.float64), axis=0).T]
        unused_edge = self.high + (self.high - self.low)
        self.register_buffer("edges", unused_edge[:, None].repeat(1, bins - 1))
        self.register_buffer("centres", self.high[:, None].repeat(1, bins))
        for index, (edges, centres) in enumerate(edges_and_centres):
            self.edges[index, : len(edges)] = torch.from_numpy(edges)
            self.centres[index, : len(centres)] = torch.from_numpy(centres)

    def encode(self, action: Tensor) -> Tensor:
        """Encode (…, D) float actions as their bins, (…, D) int64."""
        clipped_action = action.clamp(self.low, self.high)
        columns = clipped_action.reshape(-1, self.components).T.contiguous()  # (D, N)
        return torch.searchsorted(self.edges, columns, right=True).T.reshape(action.shape)

    def decode(self, token: Tensor) -> Tensor:
        """Decode (…, D) tokens as the mean of the data in their bins, (…, D) float."""
        return self.centres[torch.arange(self.components, device=token.device), token]


def _bins(values: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return edges and means of at most `bins` bins of the (N,) ascending `values`."""
    starts = np.arange(1, bins) * len(values) // bins
    # A bin starts at the first occurrence of its value. Edges lie midway between values, where rounding has no effect.
    bin_starts = np.unique(values.searchsorted(values[starts]))
    bin_starts = bin_starts[bin_starts > 0]
    edges = (values[bin_starts - 1] + values[bin_starts]) / 2
    return edges, np.array([part.mean() for part in np.split(values, bin_starts)])
