"""Output of an open-loop evaluation: errors.json, errors.png and a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vla.io.errors import counted
from vla.io.files import write_json
from vla.io.printable import display_unit
from vla.reports.pictures import BLUE, GREEN, GREY, MIDDLE, Panels, save
from vla.reports.tables import Table, unit_suffix
from vla.rollouts.open_loop import OpenLoop
from vla.runs.files import ComponentError

NOTE = (
    "Open loop: actions have no effect on what is seen next, so the errors tell how well the policy imitates the "
    "recordings, not how often it succeeds. The constant action is the mean of the training episodes."
)


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
    """Write the errors as JSON atomically, in the units of the spec, with `facts` such as parameters and latency."""
    episodes = zip(result.seeds, result.recorded, result.errors.tolist(), strict=True)
    content = {
        "seeds": result.seeds,
        "components": [asdict(component) for component in components(result)],
        "relative": result.relative,
        "checkpoint": checkpoint,
        **facts,
        "config": config,
        "per_episode": [{"seed": seed, "steps": len(steps), "errors": errors} for seed, steps, errors in episodes],
    }
    write_json(path, content)


def errors_table(errors: Sequence[ComponentError], episodes: int) -> Table:
    """Tabulate the errors over so many episodes with their intervals, in readable units."""
    rows = []
    for entry in errors:
        factor, unit = display_unit(entry.unit)
        error, low, constant = (f"{factor * value:.3g}" for value in (entry.error, entry.ci_low, entry.constant))
        high = "∞" if entry.ci_high is None else f"{factor * entry.ci_high:.3g}"
        rows.append([entry.name, unit, error, f"{low}-{high}", constant])
    heads = ("component", "unit", "error", "95 % CI", "of a constant action")
    if not any(unit for _, unit, *_ in rows):  # recordings have no units
        heads, rows = tuple(head for head in heads if head != "unit"), [[name, *rest] for name, _, *rest in rows]
    return Table(heads, rows, f"Mean absolute errors on {counted(episodes, 'held-out episode')}", NOTE)


def plot_errors(result: OpenLoop, path: Path) -> None:
    """Plot the errors as fractions of those of a constant action, and the actions of the episode of median error."""
    relative = result.errors / result.errors.mean(0).clip(1e-12)  # components of any unit count alike
    median_index = int(np.argsort(relative.mean(1))[len(result.seeds) // 2])
    panels: Panels = {"error, as a fraction of a constant action's": partial(_plot_relative, result=result)}
    for index, name in enumerate(result.spec.action):
        title = name + unit_suffix(result.spec.units[index])
        panels[title] = partial(_plot_actions, result=result, episode=median_index, component=index)
    title = f"episode {result.seeds[median_index]}: recorded (grey) and predicted (blue) actions over time [s]"
    save(path, panels, 4, title=title, ink=MIDDLE)


def _plot_relative(axes: Axes, result: OpenLoop) -> None:
    places = np.arange(len(result.spec.action))
    error, low, high = (values / result.scale for values in (result.mean, *result.interval))
    axes.barh(places, error, color=GREEN, height=0.6)
    if np.isfinite(high).all():
        axes.errorbar(error, places, xerr=[error - low, high - error], fmt="none", ecolor=GREY, capsize=3)
    axes.axvline(1, color=GREY, linestyle="--", linewidth=1)
    axes.set_yticks(places, result.spec.action)
    axes.set(ylim=(len(places) - 0.5, -0.5), xlim=(0, 1.05 * max(2.0, float(error.max()))))


def _plot_actions(axes: Axes, result: OpenLoop, episode: int, component: int) -> None:
    seconds = np.arange(len(result.recorded[episode])) / result.spec.control_hz
    axes.plot(seconds, result.recorded[episode][:, component], color=GREY, linewidth=2.5)
    axes.plot(seconds, result.predicted[episode][:, component], color=BLUE, linewidth=1)
