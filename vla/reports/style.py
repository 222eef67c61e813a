"""Style of plots and tables: colours, error bars, files, pictures within a page, Markdown."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from vla.io.files import atomic_path
from vla.reports.fonts import use_fonts, without_glyph_warnings
from vla.spec import Array

Interval = tuple[float, float, float]  # success rate and its 95 % confidence interval

GREEN, RED, BLUE, GREY = "#2e9e5b", "#d2483f", "#3b76c4", "#8a8f98"
MIDDLE = "#7a7f86"  # text that is readable on white and on black
INK = "#010203"  # placeholder for the page's text colour


def error_bars(rates: Iterable[Interval]) -> tuple[Array, Array]:
    """Return the rates (N,) and the lengths (2, N) of their error bars, below and above."""
    middle, low, high = np.array([*rates]).reshape(-1, 3).T
    return middle, np.abs([middle - low, high - middle])


def rate_limits(lowest: float) -> tuple[float, float]:
    """Return the limits of an axis of rates, on which differences between high rates stay visible.

    `lowest` is the smallest lower bound of the intervals shown.
    """
    return max(0.0, math.floor(10 * lowest) / 10), 1.0


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure as PNG atomically, with axes that have no upper and right border, in fonts of the system."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    use_fonts(figure)
    with atomic_path(path) as draft, without_glyph_warnings():
        figure.savefig(draft, format="png", dpi=dpi)


@contextmanager
def svg_style(title: str) -> Iterator[None]:
    """Set the style of figures for `as_svg`; the title makes their identifiers unique on a page."""
    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": title, "text.parse_math": False, "font.size": 9}
    settings |= {f"{part}.color": INK for part in ("text", "xtick", "ytick")}
    settings |= {"axes.edgecolor": INK, "axes.labelcolor": INK, "grid.color": INK, "axes.linewidth": 0.6}
    with matplotlib.rc_context(settings):
        yield


def as_svg(figure: Figure) -> str:
    """Convert a figure to SVG in the page's text colour, without external references, not even XML namespaces."""
    file = io.StringIO()
    with without_glyph_warnings():  # the browser draws texts in fonts of its own
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    svg = file.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace(INK, "currentColor")


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Format a Markdown table; pipes and line breaks in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)
