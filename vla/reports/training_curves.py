"""Training curves as SVG for embedding in a page, in the page's text colour."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vla.reports.style import BLUE, GREEN, GREY, RED, as_svg, svg_style
from vla.runs.folder import Curve

COLOURS = (GREEN, BLUE, RED, "#d9942b", "#8a5bb8", "#2f9fa3", "#b5628f", GREY)  # of runs, or of components
SIZE = (3.4, 2.3)  # of a figure [inch]
RIGHT, BOTTOM, TOP = 0.96, 0.12, 0.96  # ends of the axes in a figure
DECADE = 10.0  # ratio of maximum to minimum above which a loss has a logarithmic axis

# Metrics of the speed → title.
PACE = {
    "pace/samples_per_s": "samples/s",
    "pace/waiting": "waiting for data, share of the time",
    "pace/memory_gb": "memory [GB]",
}

Sections = dict[str, dict[str, str]]  # section of a page → title of a panel → SVG
Points = tuple[tuple[float, ...], tuple[float, ...]]  # steps and values
Line = tuple[str, bool, str, Points]  # label or "", logged in training (not validation), colour, curve


def draw_run(metrics: Mapping[str, Curve]) -> Sections:
    """Return the panels of a run, one per family of metrics: training and validation of one, or errors of one unit."""
    families: dict[str, list[Line]] = {}
    components: dict[str, list[str]] = {}  # of a family
    for name, curve in metrics.items():
        family, component = _family(_bare(name))
        known = components.setdefault(family, [])
        if component not in known:
            known.append(component)
        training = not name.startswith("val/")
        colour = GREY if training and not component else COLOURS[known.index(component) % len(COLOURS)]
        families.setdefault(family, []).append((component, training, colour, _points(curve)))
    return _sections(families)


def draw_runs(runs: Mapping[str, Mapping[str, Curve]]) -> Sections:
    """Return the panels of several runs, one per metric, with the curves of all."""
    families: dict[str, list[Line]] = {}
    for colour, metrics in zip(colours(len(runs)), runs.values(), strict=True):
        for name, curve in metrics.items():
            line = "", not name.startswith("val/"), colour, _points(curve)
            families.setdefault(_title(_bare(name)), []).append(line)
    return _sections(families)


def colours(count: int) -> list[str]:
    """Return `count` colours; they repeat after the eighth."""
    return [COLOURS[number % len(COLOURS)] for number in range(count)]


def _bare(name: str) -> str:
    return name.removeprefix("train/").removeprefix("val/")


def _title(name: str) -> str:
    """Format a metric's name as a title, with the unit of an error in brackets."""
    return PACE.get(name) or re.sub(r"^(error_.+)_(mm|deg)$", r"\1 [\2]", name).replace("_", " ")


def _family(name: str) -> tuple[str, str]:
    """Return the panel of a metric and its component there, or an empty string."""
    error = re.fullmatch(r"error_(.+)_(mm|deg)", name)
    return (f"error [{error[2]}]", error[1]) if error else (_title(name), "")


def _sections(families: Mapping[str, list[Line]]) -> Sections:
    """Draw all panels; validated metrics come first, among them the loss; otherwise they keep the order of logging."""

    def place(title: str) -> tuple[bool, bool]:
        return all(training for _, training, _, _ in families[title]), title != "loss"

    sections: Sections = {}
    for title in sorted(families, key=place):
        section = "Speed of the training" if title in PACE.values() else "Training"
        sections.setdefault(section, {})[title] = _draw(title, tuple(families[title]))
    return {section: sections[section] for section in sorted(sections, key="Training".__ne__)}


def _points(curve: Curve) -> Points:
    steps, values = curve
    return tuple(steps.tolist()), tuple(values.tolist())


@lru_cache(maxsize=32)  # the page of a run is written after its training, and again after its evaluation
def _draw(title: str, lines: tuple[Line, ...]) -> str:
    with svg_style(title):
        figure = Figure(figsize=SIZE)
        axes = figure.add_axes((0.0, BOTTOM, RIGHT, TOP - BOTTOM))
        for label, training, colour, (steps, values) in lines:
            few = "o" if len(steps) < (2 if training else 30) else ""  # a line of one point would not be seen
            look: dict[str, Any] = {"linewidth": 1.0, "alpha": 0.8} if training else {"linewidth": 1.7}
            look |= {"marker": few, "markersize": 3, "clip_on": title != "success"}
            axes.plot(steps, values, color=colour, label=label, **look)
        if title.endswith("loss") and _spans_decades(lines):
            axes.set_yscale("log", subs=[2, 5])
            axes.yaxis.set_minor_formatter("{x:g}")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")  # without a common factor, for which there is no room
        axes.set_xlim(left=0)  # a metric of one step would otherwise have an axis of its surroundings
        if title == "success":
            axes.set_ylim(0, 1)
        elif title.startswith("error"):
            axes.set_ylim(bottom=0)  # a small change of a small error would otherwise fill the panel
        if any(label for label, _, _, _ in lines):
            axes.legend(frameon=False, fontsize=8, ncols=3)
        axes.grid(alpha=0.12)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(width=0.6)
        # Only the left margin depends on what is drawn; a layout engine takes as long as drawing the figure twice.
        left = 0.01 - axes.yaxis.get_tightbbox().x0 / figure.bbox.width
        axes.set_position((left, BOTTOM, RIGHT - left, TOP - BOTTOM))
        return as_svg(figure)


def _spans_decades(lines: tuple[Line, ...]) -> bool:
    values = np.concatenate([values for _, _, _, (_, values) in lines])
    values = values[np.isfinite(values)]
    return bool(len(values) and values.min() > 0 and values.max() > DECADE * values.min())
