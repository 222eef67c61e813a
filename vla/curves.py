"""What was logged during training as small pictures, drawn to stand in a page in the page's own colours."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from vla.report import BLUE, GREEN, GREY, RED
from vla.results import Curve

COLOURS = (GREEN, BLUE, RED, "#d9942b", "#8a5bb8", "#2f9fa3", "#b5628f", GREY)  # of runs, or of components
SIZE = (3.4, 2.3)  # of a picture [inch]
INK = "#010203"  # stands for the colour of the page's text, which only the page knows
DECADE = 10.0  # a loss that changes by more is drawn over a logarithmic axis

Lines = list[tuple[str, bool, str, Curve]]  # label or nothing, whether it is of training steps, colour, curve


def draw_run(metrics: Mapping[str, Curve]) -> dict[str, str]:
    """Title → SVG, one for every family of metrics: training and validation of one name are a family, and so are the
    errors of all components that have one unit."""
    families: dict[str, Lines] = {}
    components: dict[str, list[str]] = {}  # of a family
    for name, curve in metrics.items():
        family, component = _family(_bare(name))
        known = components.setdefault(family, [])
        if component not in known:
            known.append(component)
        training = not name.startswith("val/")
        colour = GREY if training and not component else COLOURS[known.index(component) % len(COLOURS)]
        families.setdefault(family, []).append((component, training, colour, curve))
    return {title: _draw(title, lines) for title, lines in _ordered(families).items()}


def draw_runs(runs: Mapping[str, Mapping[str, Curve]]) -> dict[str, str]:
    """Title → SVG, one for every metric that any of them logged, with all runs in the same axes."""
    families: dict[str, Lines] = {}
    for colour, metrics in zip(colours(len(runs)), runs.values(), strict=True):
        for name, curve in metrics.items():
            families.setdefault(_title(_bare(name)), []).append(("", not name.startswith("val/"), colour, curve))
    return {title: _draw(title, lines) for title, lines in _ordered(families).items()}


def colours(count: int) -> list[str]:
    """Of so many runs; beyond the eighth they repeat."""
    return [COLOURS[number % len(COLOURS)] for number in range(count)]


def _bare(name: str) -> str:
    return name.removeprefix("train/").removeprefix("val/")


def _title(name: str) -> str:
    """A unit at the end of an error's name in brackets."""
    return re.sub(r"^(error_.+)_(mm|deg)$", r"\1 [\2]", name).replace("_", " ")


def _family(name: str) -> tuple[str, str]:
    """The panel of a metric, and the component that it is of there, or nothing."""
    error = re.fullmatch(r"error_(.+)_(mm|deg)", name)
    return (f"error [{error[2]}]", error[1]) if error else (_title(name), "")


def _ordered(families: Mapping[str, Lines]) -> dict[str, Lines]:
    """What was validated first, of that the loss; then the rest as it was logged."""

    def place(title: str) -> tuple[bool, bool]:
        return all(training for _, training, _, _ in families[title]), title != "loss"

    return {title: families[title] for title in sorted(families, key=place)}


def _draw(title: str, lines: Lines) -> str:
    """An SVG without references to anything outside of it, not even the names of its schemas."""
    import matplotlib
    from matplotlib.figure import Figure

    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": title, "text.parse_math": False, "font.size": 9}
    settings |= {f"{part}.color": INK for part in ("text", "xtick", "ytick")}
    settings |= {"axes.edgecolor": INK, "axes.labelcolor": INK, "grid.color": INK, "axes.linewidth": 0.6}
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.add_subplot()
        for label, training, colour, (steps, values) in lines:
            few = "o" if len(steps) < 30 and not training else ""
            look = {"linewidth": 1.0, "alpha": 0.8} if training else {"linewidth": 1.7, "marker": few, "markersize": 3}
            axes.plot(steps, values, color=colour, label=label, clip_on=title != "success", **look)
        if title.endswith("loss") and _spans_decades(lines):
            axes.set_yscale("log", subs=[2, 5])
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}")
        else:
            axes.ticklabel_format(useOffset=False)
        if title == "success":
            axes.set_ylim(0, 1)
        if any(label for label, _, _, _ in lines):
            axes.legend(frameon=False, fontsize=8, ncols=3)
        axes.grid(alpha=0.12)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(width=0.6)
        file = io.StringIO()
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    svg = file.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace(INK, "currentColor")


def _spans_decades(lines: Lines) -> bool:
    values = np.concatenate([values for _, _, _, (_, values) in lines])
    values = values[np.isfinite(values)]
    return bool(len(values) and values.min() > 0 and values.max() > DECADE * values.min())
