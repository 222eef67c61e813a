"""Sections of a page with training curves."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from vla.reports.page import Section
from vla.reports.pictures import svgs
from vla.runs.folder import Curve

DECADE = 10.0  # ratio of maximum to minimum above which a loss has a logarithmic axis
PACE = "pace/"  # prefix of the metrics of the speed
NOTE = "Against training steps; thin lines: training, thick lines: validation."

Line = tuple[bool, str, Curve]  # whether it was logged in training, not in validation; colour; curve


def training_sections(runs: Sequence[tuple[str, Mapping[str, Curve]]]) -> list[Section]:
    """Draw a panel per metric with the curves of all runs: colour and metrics of each.

    Metrics of validation come first, the loss before all others; otherwise the order of logging is kept.
    """
    parts: dict[str, dict[str, list[Line]]] = {"Training": {}, "Speed of the training": {}}
    for colour, metrics in runs:
        for name, curve in metrics.items():
            part = parts["Speed of the training" if name.startswith(PACE) else "Training"]
            part.setdefault(_title(name), []).append((not name.startswith("val/"), colour, curve))
    sections = []
    for heading, panels in parts.items():
        titles = sorted(panels, key=lambda title: (all(training for training, _, _ in panels[title]), title != "loss"))
        drawings = svgs({title: partial(_plot, title=title, lines=panels[title]) for title in titles})
        sections.append(Section(heading, NOTE, panels=drawings))
    return sections


def _title(name: str) -> str:
    """Return the title of a metric, with the unit of an error in brackets."""
    bare = re.sub(f"^(train/|val/|{PACE})", "", name)
    return re.sub(r"^(error_.+)_(mm|deg)$", r"\1 [\2]", bare).replace("_", " ")


def _plot(axes: Axes, title: str, lines: Sequence[Line]) -> None:
    for training, colour, (steps, values) in lines:
        marker = "o" if len(steps) < (2 if training else 30) else ""  # a line of one point would not be seen
        width = 1.0 if training else 1.8
        axes.plot(steps, values, f"{marker}-", color=colour, linewidth=width, markersize=3, clip_on=title != "success")
    if title.endswith("loss") and _spans_decades(lines):
        axes.set_yscale("log", subs=[2, 5])
        axes.yaxis.set_minor_formatter("{x:g}")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")  # without a common factor, for which there is no room
    axes.set_xlim(left=0)  # a metric with a single step would otherwise get an axis around it
    if title == "success":
        axes.set_ylim(0, 1)
    elif title.startswith("error"):
        axes.set_ylim(bottom=0)  # a small change of a small error would otherwise fill the panel
    axes.grid(alpha=0.12)


def _spans_decades(lines: Sequence[Line]) -> bool:
    values = np.concatenate([values for _, _, (_, values) in lines])
    values = values[np.isfinite(values)]
    return bool(len(values) and values.min() > 0 and values.max() > DECADE * values.min())
