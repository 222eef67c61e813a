"""Output of an open-loop evaluation: errors.json, errors.png and a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from vla.io.files import write_json
from vla.reports.style import BLUE, GREEN, GREY, save
from vla.rollouts.open_loop import OpenLoop
from vla.runs.files import ComponentError
from vla.spec import in_brackets

COLUMNS = 4  # panels of components per row


def components(result: OpenLoop) -> list[ComponentError]:
    """Return the error of every action component."""
    spec, (low, high) = result.spec, result.interval
    rows = zip(spec.action, spec.units, result.mean, low, high, result.constant_errors, strict=True)
    return [
        ComponentError(name, unit, float(error), float(least), float(most) if np.isfinite(most) else None, float(still))
        for name, unit, error, least, most, still in rows
    ]


def write_errors(
    result: OpenLoop, path: Path, checkpoint: str | None, config: Mapping[str, Any], facts: Mapping[str, Any]
) -> None:
    """Write the errors as JSON atomically, in the units of the spec.

    Args:
        result: of the evaluation.
        path: of the file.
        checkpoint: the evaluated policy.
        config: the resolved config.
        facts: further entries, such as chosen options, parameters and latency.
    """
    per_episode = zip(result.seeds, result.recorded, result.errors.tolist(), strict=True)
    content = {
        "seeds": result.seeds,
        "components": [asdict(each) for each in components(result)],
        "relative": result.relative,
        "checkpoint": checkpoint,
        **facts,
        "config": config,
        "per_episode": [{"seed": seed, "steps": len(steps), "errors": errors} for seed, steps, errors in per_episode],
    }
    write_json(path, content)


def errors_table(result: OpenLoop) -> Table:
    """Tabulate the errors with their intervals, in readable units."""
    title = f"mean absolute errors on {len(result.seeds)} held-out episodes, open loop"
    table = Table("component", "unit", "error", "95 % CI", "of a constant action", title=title)
    for each in components(result):
        table.add_row(each.name, *each.readable())
    return table


def plot_errors(result: OpenLoop, path: Path) -> None:
    """Plot the errors, and the recorded and predicted actions of the episode of median error."""
    spec, rows = result.spec, -(-len(result.spec.action) // COLUMNS)
    height = 1.2 + 0.25 * len(spec.action)
    figure = Figure(figsize=(13, height + 1.9 * rows), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[height, 1.9 * rows])
    _plot_relative(above.subplots(), result)
    typical = int(np.argsort((result.errors / result.errors.mean(0).clip(1e-12)).mean(1))[len(result.seeds) // 2])
    below.suptitle(f"episode {result.seeds[typical]}: recorded (grey) and predicted (blue) actions", fontsize=11)
    seconds = np.arange(len(result.recorded[typical])) / spec.control_hz
    panels = np.ravel(below.subplots(rows, COLUMNS, sharex=True, squeeze=False))
    for index, axes in enumerate(panels):
        if index >= len(spec.action):
            axes.axis("off")
            continue
        axes.plot(seconds, result.recorded[typical][:, index], color=GREY, linewidth=2.5)
        axes.plot(seconds, result.predicted[typical][:, index], color=BLUE, linewidth=1)
        axes.set_title(spec.action[index] + in_brackets(spec.units[index]), fontsize=9)
        axes.tick_params(labelsize=8)
    for axes in panels[max(len(spec.action) - COLUMNS, 0) : len(spec.action)]:
        axes.set_xlabel("time [s]", fontsize=8)
        axes.tick_params(labelbottom=True)
    save(figure, path)


def _plot_relative(axes: Axes, result: OpenLoop) -> None:
    """Plot the errors as fractions of those of the constant action."""
    names, places = list(result.spec.action)[::-1], np.arange(len(result.spec.action))
    scale = result.scale[::-1]
    error = result.mean[::-1] / scale
    low, high = (bound[::-1] / scale for bound in result.interval)
    axes.barh(places, error, color=GREEN, height=0.6)
    if np.isfinite(high).all():
        axes.errorbar(error, places, xerr=[error - low, high - error], fmt="none", ecolor="black", capsize=3)
    axes.axvline(1, color=GREY, linestyle="--", linewidth=1)
    furthest = float(np.max(np.where(np.isfinite(high), high, error)))
    axes.set_xlim(0, 1.05 * float(np.clip(furthest, 1.05, max(2.0, float(np.max(error))))))
    axes.set_yticks(places, names, fontsize=9)
    axes.set_xlabel("error as a fraction of that of a constant action (dashed)")
    axes.set_title(f"open-loop errors on {len(result.seeds)} held-out episodes", fontsize=11, loc="left")
