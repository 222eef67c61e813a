"""What is drawn in a figure: a file of the right size can be blank."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import FigureBase
from matplotlib.patches import Rectangle
from matplotlib.text import Text

Points = list[tuple[float, float]]


def texts(part: Axes | FigureBase) -> set[str]:
    """The texts in a figure or panel, those of ticks and legends included."""
    return {found.get_text() for found in part.findobj(Text) if isinstance(found, Text)}


def panels(figure: FigureBase, title: str) -> list[Axes]:
    """The visible panels of a title, in order."""
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_title() == title]


def points(axes: Axes) -> Points:
    """The points with error bars, in order."""
    drawn = [each.lines[0] for each in axes.containers if isinstance(each, ErrorbarContainer)]
    return [_rounded(x, y) for line in drawn if line is not None for x, y in line.get_xydata().tolist()]


def spans(axes: Axes) -> list[tuple[float, float]]:
    """The ends of the error bars, in order."""
    bars = [each for each in axes.containers if isinstance(each, ErrorbarContainer)]
    segments = [segment for each in bars for lines in each.lines[2] for segment in lines.get_segments()]
    return [_rounded(*(ends[:, 0] if ends[0, 0] != ends[1, 0] else ends[:, 1])) for ends in segments]


def bars(axes: Axes) -> list[float]:
    """The sizes of the bars that lie, in order."""
    return [patch.get_width() for patch in axes.patches if isinstance(patch, Rectangle)]


def heights(axes: Axes) -> list[float]:
    """The heights of the bars that stand, in order."""
    return [patch.get_height() for patch in axes.patches if isinstance(patch, Rectangle)]


def _rounded(x: float, y: float) -> tuple[float, float]:
    return round(float(x), 3), round(float(y), 3)
