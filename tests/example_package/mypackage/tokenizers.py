"""A tokenizer. Shapes: D action components, K bins."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from vla.io.types import Bins
from vla.models.tokenizers.tokenizer import EvenBins
from vla.spec import ActionStatistics, Spec


class Few(EvenBins):
    """Few bins over the range of allowed actions, whatever the data.

    Args:
        bins: K.
        spec: gives the range.
        statistics: of the data, not needed.
    """

    def __init__(self, bins: Bins, *, spec: Spec, statistics: ActionStatistics | None = None) -> None:
        super().__init__(spec, np.array(spec.low), np.array(spec.high), bins)

    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions as the nearest of the K tokens, (…, D) int64."""
        share = (action - self.low) / (self.high - self.low)
        return (share.clamp(0, 1) * (self.bins - 1)).round().long()
