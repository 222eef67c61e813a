"""Picture of the first training windows: images, instruction and action labels."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vla.reports.pictures import GREEN, MIDDLE, Panels, plot_image, save
from vla.spec import Array, Spec, readable

SHOWN = 6  # windows


def draw_samples(batch: dict[str, Any], spec: Spec, path: Path) -> None:
    """Draw the newest frame of every window of a batch with its action label into a PNG file, written atomically.

    Args:
        batch: `rgb` of each camera (B, T, H, W, 3) uint8, `action` (B, T, k, D) and B `instruction`s.
        spec: of the demonstrations.
        path: of the PNG.
    """
    actions = np.asarray(batch["action"])[:, -1, 0]  # (B, D)
    panels: Panels = {}
    for index, sentence in enumerate(batch["instruction"]):
        frames = [np.asarray(images)[index, -1] for images in batch["rgb"].values()]  # (H, W, 3) each
        panels[f"{index + 1}: {sentence}"] = partial(_plot, frames=frames, action=actions[index], spec=spec)
    save(path, panels, 2, (6, 2), ink=MIDDLE)


def _plot(axes: Axes, frames: list[Array], action: Array, spec: Spec) -> None:
    """Plot the images, and beside them a bar per component (D,) of the action within its range, with its value."""
    height = frames[0].shape[0]
    plot_image(axes, np.concatenate([frame for frame in frames if frame.shape[0] == height], axis=1))
    left, step = axes.get_xlim()[1] + 1.0 * height, height / len(action)
    reach = np.maximum(np.abs(spec.low), np.abs(spec.high))
    shares = np.clip(action / reach, -1, 1)
    places = step * (np.arange(len(action)) + 0.5)
    axes.barh(places, 0.5 * height * shares, 0.6 * step, left=left, color=GREEN, clip_on=False)
    for place, name, value, unit in zip(places, spec.action, action, spec.units, strict=True):
        factor, shown = readable(unit)
        number = factor * float(value)
        text = f"{round(number, 1) + 0.0:.1f} {shown}" if shown else f"{round(number, 4) + 0.0:.2g}"  # never "-0.0"
        axes.text(left - 0.55 * height, place, name, ha="right", va="center", fontsize=7)
        axes.text(left + 0.55 * height, place, text, va="center", fontsize=7)
    axes.set_xlim(right=left + height)
