"""Pictures of results: panels, drawn together into one PNG file, or each as SVG in the colour of a page's text."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager

from vla.io.files import atomic_path
from vla.rollouts.results import Rate
from vla.spec import Array

Panels = dict[str, Callable[[Axes], object]]  # title → function that draws the panel

GREEN, RED, BLUE, GREY = "#2e9e5b", "#d2483f", "#3b76c4", "#8a8f98"
COLOURS = (GREEN, BLUE, RED, "#d9942b", "#8a5bb8", "#2f9fa3", "#b5628f", GREY)  # of rows
INK = "#010203"  # black, and on a page the colour of its text
MIDDLE = "#7a7f86"  # readable on white and on black, for PNG files on a page
SIZE = (3.4, 2.3)  # of a panel [inch]
DPI, LONGEST = 110, 65_000  # of a PNG file; its largest height or width, which Matplotlib 3.10 limits [px]


def error_bars(rates: Iterable[Rate]) -> tuple[Array, Array]:
    """Return the rates (N,) and the lengths (2, N) of their error bars, below and above."""
    middle, low, high = np.array([*rates]).reshape(-1, 3).T
    return middle, np.abs([middle - low, high - middle])


def rate_limits(lowest: float) -> tuple[float, float]:
    """Return the limits of an axis of rates, from about `lowest` to 1, which shows differences between high rates."""
    return max(0.0, math.floor(10 * lowest) / 10), 1.0


def plot_rates(axes: Axes, rates: Mapping[str, Rate], colours: Mapping[str, str]) -> None:
    """Plot a line per name with its success rate and interval, and a vertical line at the first rate."""
    middles, reach = error_bars(rates.values())
    for row, name in enumerate(rates):
        colour, ends = colours.get(name, GREEN), reach[:, row, None]
        axes.errorbar(middles[row], row, xerr=ends, fmt="o", color=colour, capsize=3, clip_on=False)
    axes.axvline(middles[0], color=GREY, linewidth=0.8, linestyle=":")
    axes.set_yticks(range(len(rates)), [*rates])
    axes.set(ylim=(len(rates) - 0.5, -0.5), xlim=rate_limits(min(low for _, low, _ in rates.values())))
    axes.grid(alpha=0.2)


def plot_counts(axes: Axes, counts: Mapping[str, int], colours: Iterable[str]) -> None:
    """Plot one bar per word with its count, the first on top."""
    axes.barh(range(len(counts)), list(counts.values()), color=[*colours], alpha=0.45, height=0.8)
    for row, (name, count) in enumerate(counts.items()):
        axes.text(0, row, f" {count}  {name}", fontsize=8, va="center", clip_on=True)
    axes.set(ylim=(max(len(counts), 4) - 0.5, -0.5), xticks=[], yticks=[])
    axes.spines[["left", "bottom"]].set_visible(False)


def plot_image(axes: Axes, image: Array) -> None:
    """Show an image (H, W, 3), whose upper left corner is the origin, without axes."""
    axes.imshow(image, interpolation="nearest", extent=(0, image.shape[1], image.shape[0], 0))
    axes.axis("off")


@contextmanager
def _style(ink: str = INK) -> Iterator[None]:
    """Apply the style of all plots within the context."""
    # Fonts of the machine for characters that matplotlib's own lacks, such as those of fonts-noto-cjk.
    families = ["DejaVu Sans", *sorted({font.name for font in fontManager.ttflist if "CJK" in font.name})]
    settings: Any = {
        "font.family": families,
        "text.parse_math": False,
        "font.size": 9,
        "axes.titlesize": 9,
        "axes.linewidth": 0.6,
    }
    settings |= {f"axes.spines.{side}": False for side in ("top", "right")} | {"svg.fonttype": "none"}
    settings |= {f"{part}.color": ink for part in ("text", "xtick", "ytick", "grid")}
    settings |= {f"axes.{part}": ink for part in ("edgecolor", "labelcolor", "titlecolor")}
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from")  # browsers have more fonts
        yield


def save(
    path: Path, panels: Panels, columns: int, size: tuple[float, float] = SIZE, title: str = "", ink: str = INK
) -> None:
    """Draw panels, each of `size` [inch], in rows of `columns` into a PNG file, atomically.

    Text and axes have the colour `ink`; unless it is black, the background is transparent.
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    with _style(ink):
        figure = Figure((size[0] * columns, size[1] * rows + 0.4 * bool(title)), layout="constrained")
        figure.suptitle(title, fontsize=12, fontweight="bold")
        for number, (name, draw) in enumerate(panels.items()):
            axes = figure.add_subplot(rows, columns, number + 1)
            axes.set_title(fill(name, int(14 * size[0])))
            draw(axes)
        with atomic_path(path) as draft:
            dpi = min(DPI, LONGEST / max(figure.get_size_inches()))
            figure.savefig(draft, format="png", dpi=dpi, transparent=ink != INK)


def svgs(panels: Panels) -> dict[str, Markup]:
    """Return title → SVG without the title, in the colour of the page's text and without external references."""
    return {title: _svg(title, draw) for title, draw in panels.items()}


def _svg(title: str, draw: Callable[[Axes], object]) -> Markup:
    file = io.StringIO()
    with _style(), matplotlib.rc_context({"svg.hashsalt": title}):  # identifiers are unique on a page
        figure = Figure(SIZE, layout="constrained")
        draw(figure.add_subplot())
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    svg = file.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    return Markup(re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace(INK, "currentColor"))
