"""Statistics of a dataset in LeRobot's form.

Shapes: N steps, D components.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.spec import Array

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
NAMES = ("q01", "q10", "q50", "q90", "q99")

Statistics = dict[str, Any]


def moments(values: Array) -> Statistics:
    """Compute moments and quantiles of (N,) or (N, D) values over the steps, one number per component."""
    values = values.reshape(len(values), -1).astype(np.float64)
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    found |= zip(NAMES, np.quantile(values, QUANTILES, axis=0), strict=True)
    return {name: value.tolist() for name, value in found.items()} | {"count": [len(values)]}


def image_moments(counts: Array, images: int) -> Statistics:
    """Compute the same of images in the range 0…1 from their histograms, `counts` (3, 256); shape (3, 1, 1)."""
    levels, total = np.arange(256) / 255, counts.sum(1)
    mean = counts @ levels / total
    rising = counts.cumsum(1) / total[:, None]
    found = {
        "min": levels[(counts > 0).argmax(1)],
        "max": levels[255 - (counts[:, ::-1] > 0).argmax(1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
    }
    found |= {name: levels[(rising >= share).argmax(1)] for name, share in zip(NAMES, QUANTILES, strict=True)}
    return {name: value.reshape(3, 1, 1).tolist() for name, value in found.items()} | {"count": [images]}
