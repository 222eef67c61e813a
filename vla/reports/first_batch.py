"""Picture of the first training windows: images, instruction and action labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vla.reports.style import GREEN, GREY, save
from vla.spec import READABLE, Array, Spec

FILE = "samples.png"
SHOWN = 6  # windows
COLUMNS = 2  # windows side by side


def draw_samples(batch: dict[str, Any], spec: Spec, path: Path) -> None:
    """Draw the newest frame of every window of a batch with its action label, as a PNG written atomically.

    Args:
        batch: `rgb` of each camera (B, T, H, W, 3) uint8, `action` (B, T, k, D) and B `instruction`s.
        spec: of the demonstrations.
        path: of the PNG.
    """
    sentences, actions = batch["instruction"], np.asarray(batch["action"])[:, -1, 0]  # (B, D)
    rows, cameras = -(-len(sentences) // COLUMNS), [*batch["rgb"]]
    figure = Figure(figsize=(5.8 * COLUMNS, 1.95 * rows), layout="constrained", facecolor="white")
    cells = figure.subfigures(rows, COLUMNS, squeeze=False, wspace=0.03).ravel()
    for index, (cell, sentence) in enumerate(zip(cells, sentences, strict=False)):
        cell.suptitle(sentence, fontsize=9.5, x=0.02, ha="left", parse_math=False)
        *images, labels = cell.subplots(1, len(cameras) + 1, width_ratios=[*(1 for _ in cameras), 1.25])
        for axes, camera in zip(images, cameras, strict=True):
            axes.imshow(np.asarray(batch["rgb"][camera])[index, -1])
            axes.axis("off")
        _plot_action(labels, actions[index], spec)
    save(figure, path, dpi=130)


def _plot_action(axes: Axes, action: Array, spec: Spec) -> None:
    """Plot a bar per component (D,) within its range, with its value."""
    low, high = np.array(spec.low), np.array(spec.high)
    shares = np.clip(action / np.maximum(np.abs(low), np.abs(high)), -1, 1)
    places, least = np.arange(len(action)), np.where(low < 0, -1.0, 0.0)
    axes.barh(places, 1 - least, left=least, color=GREY, alpha=0.12)
    axes.barh(places, shares, color=GREEN, height=0.6)
    for place, (value, unit) in enumerate(zip(action, spec.units, strict=True)):
        factor, readable = READABLE.get(unit, (1.0, unit))
        number = round(factor * float(value), 1) + 0.0  # never "-0.0"
        text = f"{number:.1f} {readable}" if readable else f"{number:.2g}"
        axes.text(1.12, place, text, va="center", fontsize=7.5)
    axes.set_yticks(places, spec.action, fontsize=7.5)
    axes.set_xlim(-1.05, 1.75)
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.tick_params(left=False)
    axes.spines[:].set_visible(False)
