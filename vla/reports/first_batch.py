"""Picture of the first training windows: images, instruction and action labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vla.reports.style import GREEN, GREY, MIDDLE, save
from vla.spec import Array, Spec, readable

SHOWN = 6  # windows
COLUMNS = 2  # windows side by side
HEIGHT, TITLE, GAP = 1.5, 0.4, 0.08  # of an image, above it, between parts [inch]
LETTER, BAR, VALUE = 0.065, 1.2, 0.7  # widths of a letter, of a bar and of a value [inch]


def draw_samples(batch: dict[str, Any], spec: Spec, path: Path) -> None:
    """Draw the newest frame of every window of a batch with its action label, as a transparent PNG written atomically.

    Args:
        batch: `rgb` of each camera (B, T, H, W, 3) uint8, `action` (B, T, k, D) and B `instruction`s.
        spec: of the demonstrations.
        path: of the PNG.
    """
    sentences, actions = batch["instruction"], np.asarray(batch["action"])[:, -1, 0]  # (B, D)
    images = [np.asarray(frames)[:, -1] for frames in batch["rgb"].values()]  # (B, H, W, 3) each
    widths = [HEIGHT * image.shape[2] / image.shape[1] for image in images]
    names = LETTER * max(map(len, spec.action))
    width = sum(widths) + names + BAR + VALUE + GAP * (len(images) + 4)
    height = HEIGHT + TITLE + GAP
    total = COLUMNS * width, -(-len(sentences) // COLUMNS) * height
    figure = Figure(figsize=total, facecolor="none")
    axes = figure.add_axes((0, 0, 1, 1))  # a single one, in inches: each takes as long to draw as all that is in it
    for index, sentence in enumerate(sentences):
        left, bottom = index % COLUMNS * width + GAP, total[1] - (index // COLUMNS + 1) * height + GAP
        axes.text(left, bottom + HEIGHT + GAP, sentence, fontsize=9.5, color=MIDDLE, parse_math=False)
        for image, wide in zip(images, widths, strict=True):
            axes.imshow(image[index], extent=(left, left + wide, bottom, bottom + HEIGHT))
            left += wide + GAP
        _plot_action(axes, left + names + GAP, bottom, actions[index], spec)
    axes.set(xlim=(0, total[0]), ylim=(0, total[1]))
    axes.axis("off")
    save(figure, path, dpi=130)


def _plot_action(axes: Axes, left: float, bottom: float, action: Array, spec: Spec) -> None:
    """Plot a bar per component (D,) within its range, with its name and value, from a corner on [inch]."""
    low, high = np.array(spec.low), np.array(spec.high)
    shares = np.clip(action / np.maximum(np.abs(low), np.abs(high)), -1, 1)
    step, zero = HEIGHT / len(action), left + BAR / 2
    places, least = bottom + HEIGHT - step * (np.arange(len(action)) + 0.5), np.where(low < 0, -1.0, 0.0)
    axes.barh(places, (1 - least) * BAR / 2, 0.8 * step, left=zero + least * BAR / 2, color=GREY, alpha=0.12)
    axes.barh(places, shares * BAR / 2, 0.6 * step, left=zero, color=GREEN)
    for place, name, value, unit in zip(places, spec.action, action, spec.units, strict=True):
        factor, shown = readable(unit)
        number = factor * float(value)
        text = f"{round(number, 1) + 0.0:.1f} {shown}" if shown else f"{round(number, 4) + 0.0:.2g}"  # never "-0.0"
        axes.text(left - GAP, place, name, ha="right", va="center", fontsize=7.5, color=MIDDLE, parse_math=False)
        axes.text(left + BAR + GAP, place, text, va="center", fontsize=7.5, color=MIDDLE, parse_math=False)
