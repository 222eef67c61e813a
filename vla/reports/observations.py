"""Pictures of observations, of resets of a world and of training windows, and a table of what was drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from vla.data.episode_filter import flatten, leaves
from vla.io.printable import display_unit
from vla.reports.pictures import GREEN, MIDDLE, Panels, plot_image, save
from vla.reports.tables import Table
from vla.spec import Array, Observation, Spec

SHOWN_WINDOWS = 6  # windows of the first training batch


def reset_panels(seeds: Sequence[int], observations: Sequence[Observation]) -> Panels:
    """Return a panel per episode: the colour image of every camera, then its depth image, from near (blue) to far (red)
    in one range for all episodes; pixels without a return appear as near."""
    panels: Panels = {}
    for seed, observation in zip(seeds, observations, strict=True):
        images = [*observation.rgb.values()]
        for name, depth in observation.depth.items():
            all_depths = np.stack([other.depth[name] for other in observations])  # [mm]
            low, high = np.percentile(all_depths[all_depths > 0], (1, 90)) if all_depths.any() else (0.0, 1.0)
            shades = np.clip((depth - low) / max(high - low, 1.0), 0, 1)
            images.append((255 * colormaps["turbo"](shades)[..., :3]).astype(np.uint8))
        panels[f"seed {seed}: {observation.instruction}"] = partial(plot_image, image=np.concatenate(images, axis=1))
    return panels


def draws_table(seeds: Sequence[int], draws: Sequence[Mapping[str, Any]]) -> Table:
    """Tabulate the draws of several resets: range of numbers or set of words, and the values of the first reset."""
    first_draws, rows = flatten(draws[0]), []
    for name, span in spans(draws).items():
        values = [f"{leaf:.3g}" if isinstance(leaf, float) else str(leaf) for leaf in leaves(first_draws.get(name))]
        rows.append([name, span, " ".join(values)])
    return Table(("draw", "range", f"seed {seeds[0]}"), rows, f"resets: {len(draws)}")


def spans(draws: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return dotted name → range of the numbers, or set of the words, drawn under that name."""
    values_by_name: dict[str, list[Any]] = {}
    for draw in draws:
        for name, value in flatten(draw).items():
            values_by_name.setdefault(name, []).extend(leaves(value))
    return {
        name: f"{min(values):.4g} … {max(values):.4g}"
        if values and all(isinstance(value, (int, float)) for value in values)
        else ", ".join(sorted({str(value) for value in values}))
        for name, values in values_by_name.items()
    }


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
    plot_image(axes, np.concatenate(frames, axis=1))
    left, step = axes.get_xlim()[1] + 1.0 * height, height / len(action)
    reach = np.maximum(np.abs(spec.low), np.abs(spec.high))
    shares = np.clip(action / reach, -1, 1)
    places = step * (np.arange(len(action)) + 0.5)
    axes.barh(places, 0.5 * height * shares, 0.6 * step, left=left, color=GREEN, clip_on=False)
    for place, name, value, unit in zip(places, spec.action, action, spec.units, strict=True):
        factor, label = display_unit(unit)
        number = factor * float(value)
        text = f"{round(number, 1) + 0.0:.1f} {label}" if label else f"{round(number, 4) + 0.0:.2g}"  # never "-0.0"
        axes.text(left - 0.55 * height, place, name, ha="right", va="center", fontsize=7)
        axes.text(left + 0.55 * height, place, text, va="center", fontsize=7)
    axes.set_xlim(right=left + height)
