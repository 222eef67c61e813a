"""Normalisation of states and actions by statistics of a dataset, which have LeRobot's names.

Shapes: N steps, W components, … any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from vla.io.errors import UserError

Kind = Literal["mean_std", "quantiles"]
MODES: dict[Kind, str] = {"mean_std": "MEAN_STD", "quantiles": "QUANTILES"}  # LeRobot's names
CONSTANT = 1e-6  # a component with at most this range counts as never changing
RARE = 0.02  # a component whose percentiles are at most this share of its range apart counts as rarely changing
EPSILON = 1e-8  # added to a standard deviation, and used in place of a range of 0


class Normalizer(nn.Module):
    """Scales values to mean 0 and standard deviation 1, or percentiles 1 and 99 to -1 and 1; nothing is clipped.

    Args:
        kind: which of the two.
        width: W.
    """

    mean: Tensor
    std: Tensor
    q01: Tensor
    q99: Tensor

    def __init__(self, kind: Kind, width: int) -> None:
        super().__init__()
        self.kind, self.statistics = kind, ("mean", "std") if kind == "mean_std" else ("q01", "q99")
        identity = torch.zeros(width) if kind == "mean_std" else -torch.ones(width)
        self.register_buffer(self.statistics[0], identity)
        self.register_buffer(self.statistics[1], torch.ones(width))

    def fit(self, values: np.ndarray, floor: np.ndarray | float = 0.0, constant: float = 0.0) -> None:
        """Compute the statistics of (N, W) values.

        The extremes of a component that rarely changes, such as a gripper, take the place of its percentiles, or its
        changes would be huge. Standard deviation and half the range are at least `floor`, because what is noise here
        may be a motion in other values, and of a component that never changes also at least `constant`.
        """
        minimum, maximum = values.min(0), values.max(0)
        floor = np.where(maximum - minimum > CONSTANT, floor, np.maximum(floor, constant))
        if self.kind == "mean_std":
            estimates = values.mean(0, dtype=np.float64), np.maximum(values.std(0, dtype=np.float64), floor)
        else:
            low, high = np.quantile(values, (0.01, 0.99), axis=0)
            rare = high - low <= RARE * (maximum - minimum)
            low, high = np.where(rare, minimum, low), np.where(rare, maximum, high)
            widening = np.maximum(floor - (high - low) / 2, 0.0)
            estimates = low - widening, high + widening
        for name, value in zip(self.statistics, estimates, strict=True):
            getattr(self, name).copy_(torch.from_numpy(value))

    def take(self, statistics: Mapping[str, Tensor], feature: str, source: object) -> None:
        """Use published statistics, name → (W,), of a feature such as "action".

        Raises:
            UserError: they lack the feature, or have another width.
        """
        for name in self.statistics:
            buffer, published_values = getattr(self, name), statistics.get(f"{feature}.{name}")
            if published_values is None:
                raise UserError(f"{source} has no statistics {feature}.{name}: choose model.statistics=demonstrations")
            if published_values.shape != buffer.shape:
                sizes = f"{published_values.numel()} components, not of {buffer.numel()}"
                raise UserError(f"{source} has {feature}.{name} of {sizes}: choose model.statistics=demonstrations")
            buffer.copy_(published_values)

    def forward(self, values: Tensor) -> Tensor:
        """Normalise (…, W) values."""
        if self.kind == "mean_std":
            return (values - self.mean) / (self.std + EPSILON)
        return 2 * (values - self.q01) / self._range - 1

    def inverse(self, values: Tensor) -> Tensor:
        """Invert `forward`."""
        if self.kind == "mean_std":
            return values * self.std + self.mean
        return (values + 1) * self._range / 2 + self.q01

    @property
    def _range(self) -> Tensor:
        span = self.q99 - self.q01
        return torch.where(span == 0, EPSILON, span)
