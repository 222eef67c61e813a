"""What all plots share: colours, error bars and the files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vla.io.files import atomic_path
from vla.spec import Array

Interval = tuple[float, float, float]  # success rate and its 95 % confidence interval

GREEN, RED, BLUE, GREY = "#2e9e5b", "#d2483f", "#3b76c4", "#8a8f98"


def error_bars(rates: Iterable[Interval]) -> tuple[Array, Array]:
    """Return the rates (N,) and the lengths (2, N) of their error bars, below and above."""
    middle, low, high = np.array([*rates]).reshape(-1, 3).T
    return middle, np.abs([middle - low, high - middle])


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure as PNG atomically, with axes that have no upper and right border."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    with atomic_path(path) as draft:
        figure.savefig(draft, format="png", dpi=dpi)
