"""A sweep as a picture: success over what was varied, with its intervals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vla.evaluate import wilson_interval
from vla.results import read_run
from vla.sweep import DEMONSTRATIONS, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Points = dict[int, tuple[int, int]]  # training step → episodes that succeeded in its validation, and all played then


def plot(rows: list[Row], path: Path) -> None:
    """Draw success over the number of demonstrations, and over training, where that number is what differs, else over
    the time of an action."""
    from matplotlib.figure import Figure

    if DEMONSTRATIONS in rows[0].choices:
        conditions, lines = list(rows[0].successes), _lines(rows)
        seen = {name: {row.choices[DEMONSTRATIONS]: validated(row) for row in line} for name, line in lines.items()}
        trained = {name: curves for name, curves in seen.items() if any(curves.values())}
        columns = max(len(conditions), len(trained))
        figure = Figure(figsize=(max(8, 5.5 * columns), 10 if trained else 5), layout="constrained")
        panels = figure.subplots(2 if trained else 1, columns, squeeze=False)
        for axes, condition in zip(panels[0], conditions, strict=False):
            _plot_curves(axes, lines, condition)
        for axes, (name, curves) in zip(panels[-1], trained.items(), strict=False):
            _plot_training(axes, name, curves)
        for axes in panels.flat:
            axes.set_visible(axes.has_data())
    else:
        figure = Figure(figsize=(8, 5), layout="constrained")
        _plot_costs(figure.add_subplot(), rows)
    for axes in figure.axes:
        axes.set_ylabel("success, 95 % CI")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110, format="png")


def validated(row: Row) -> Points:
    """Of all cells together; nothing where nothing was played."""
    points: Points = {}
    for run in map(read_run, row.cells):
        played = run.config.get("validate", {}).get("episodes", 0)
        if not played:
            continue
        for step, share in zip(*run.metrics.get("val/success", ((), ())), strict=True):
            won, others = points.get(int(step) + 1, (0, 0))
            points[int(step) + 1] = won + round(share * played), others + played
    return points


def _lines(rows: list[Row]) -> dict[str, list[Row]]:
    """What rows have in common beside the number of demonstrations → these rows, fewest demonstrations first."""
    lines: dict[str, list[Row]] = {}
    for row in sorted(rows, key=_demonstrations):
        lines.setdefault(" ".join(value for key, value in row.choices.items() if key != DEMONSTRATIONS), []).append(row)
    return lines


def _demonstrations(row: Row) -> int:
    return int(row.choices[DEMONSTRATIONS])


def _plot_curves(axes: Axes, lines: dict[str, list[Row]], condition: str) -> None:
    """Success under one condition over the number of demonstrations."""
    for name, line in lines.items():
        played = [row for row in line if condition in row.successes]
        rates = [row.interval(condition) for row in played]
        reach = [[rate - low for rate, low, _ in rates], [high - rate for rate, _, high in rates]]
        counts = [_demonstrations(row) for row in played]
        axes.errorbar(counts, [rate for rate, _, _ in rates], reach, fmt="o-", capsize=3, label=name)
    axes.set_xscale("log")
    axes.set_xticks(sorted({_demonstrations(row) for line in lines.values() for row in line}))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel("demonstrations")
    axes.set_title(condition, fontsize=10)
    if len(lines) > 1:
        axes.legend(frameon=False)


def _plot_training(axes: Axes, name: str, curves: dict[str, Points]) -> None:
    """Success in validation over the steps of training, a line for each number of demonstrations."""
    from matplotlib import colormaps

    for number, (demonstrations, points) in enumerate(curves.items()):
        intervals = [wilson_interval(*point) for point in points.values()]
        colour = colormaps["viridis_r"]((number + 1) / len(curves))
        rates = [won / played for won, played in points.values()]
        axes.plot(list(points), rates, "o-", color=colour, markersize=4, label=demonstrations)
        low, high = [low for low, _ in intervals], [high for _, high in intervals]
        axes.fill_between(list(points), low, high, color=colour, alpha=0.1, linewidth=0)
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel("steps of training")
    axes.set_title(", ".join(filter(None, (name, "in validation"))), fontsize=10)
    axes.legend(frameon=False, title="demonstrations")


def _plot_costs(axes: Axes, rows: list[Row]) -> None:
    """Success over the time of an action; the area of a point grows with the parameters, and a line joins what nothing
    else beats in both."""
    axes.set_xscale("log")
    for row in rows:
        rate, low, high = row.seen
        axes.errorbar(row.latency, rate, [[rate - low], [high - rate]], color="#8a8f98", capsize=3, zorder=1)
        axes.scatter(row.latency, rate, s=40 + 60 * (row.parameters / 1e6) ** 0.5, color="#2e9e5b", alpha=0.8)
        label = f"{row.name}, {row.parameters / 1e6:.2f} M"
        axes.annotate(label, (row.latency, rate), (9, 5), textcoords="offset points", fontsize=9)
    best = pareto(rows)
    axes.plot([row.latency for row in best], [row.seen[0] for row in best], color="#2e9e5b", linewidth=0.8)
    axes.set_xlim(0.6 * min(row.latency for row in rows), 2.5 * max(row.latency for row in rows))
    axes.xaxis.set_major_formatter("{x:g}")
    close = max(row.latency for row in rows) < 10 * min(row.latency for row in rows)
    axes.xaxis.set_minor_formatter("{x:g}" if close else "")
    axes.set_xlabel("time of an action [ms]")


def pareto(rows: list[Row]) -> list[Row]:
    """The rows that no faster one matches in success, fastest first."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.latency, -row.seen[0])):
        if not best or row.seen[0] > best[-1].seen[0]:
            best.append(row)
    return best
