"""Plot of a sweep: success with intervals over the varied options."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.ticker import LogLocator

from vla.config.differences import at
from vla.reports.style import GREY, error_bars, save
from vla.rollouts.statistics import wilson_interval
from vla.runs.sweep import DEMONSTRATIONS, SweepRow, conditions_of

SUCCESS = "success, 95 % CI"
COLUMNS = 4  # panels per row

Points = dict[int, tuple[int, int]]  # training step → successes and episodes of its validation


def plot(rows: list[SweepRow], path: Path) -> None:
    """Plot success per condition.

    If the sweep varies the number of demonstrations: success over that number, and over training steps. Otherwise:
    success of each row, and over the time per action if that differs by more than a factor of two.
    """
    figure = Figure(layout=ConstrainedLayoutEngine(h_pad=0.1))
    if DEMONSTRATIONS in rows[0].choices:
        _draw_numbers(figure, rows)
    else:
        _draw_choices(figure, rows)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    save(figure, path)


def _draw_numbers(figure: Figure, rows: list[SweepRow]) -> None:
    conditions, lines = conditions_of(rows), _lines(rows)
    curves = {name: {str(_demonstrations(row)): validated(row) for row in line} for name, line in lines.items()}
    trained = {name: each for name, each in curves.items() if any(each.values())}
    columns = max(len(conditions), len(trained))
    figure.set_size_inches(max(8, 5.5 * columns), 10 if trained else 5)
    panels = figure.subplots(2 if trained else 1, columns, squeeze=False)
    for axes, condition in zip(panels[0], conditions, strict=False):
        _plot_curves(axes, lines, condition)
    if len(lines) > 1:  # the lines are the same in every panel
        panels[0][0].legend(title=", ".join(key for key in rows[0].choices if key != DEMONSTRATIONS), frameon=False)
    for axes, (name, each) in zip(panels[-1], trained.items(), strict=False):
        _plot_training(axes, name, each, sorted({_demonstrations(row) for row in rows}))
    if trained:
        _add_legend(panels[-1][: len(trained)]).set_in_layout(columns == len(trained))  # free panels leave room
    for axes in panels.flat:
        axes.set_visible(axes.has_data())
        axes.set_ylabel(SUCCESS)


def _add_legend(panels: Sequence[Axes]) -> Legend:
    """Add one legend for all training panels, beside the last."""
    lines: dict[str, Artist] = {}
    for axes in panels:
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True):
            lines.setdefault(label, line)
    labels = sorted(lines, key=int)
    handles, place = [lines[label] for label in labels], (1.02, 0.5)
    return panels[-1].legend(
        handles, labels, title="demonstrations", loc="center left", bbox_to_anchor=place, frameon=False
    )


def _draw_choices(figure: Figure, rows: list[SweepRow]) -> None:
    conditions = conditions_of(rows)
    latencies = [row.latency for row in rows if row.latencies]
    lines = [conditions[first : first + COLUMNS] for first in range(0, len(conditions), COLUMNS)]
    heights = [1.2 + 0.3 * len(rows)] * len(lines)
    if costs := bool(latencies) and max(latencies) > 2 * min(latencies):
        heights.append(4.2)
    figure.set_size_inches(max(8, 2 + 3.3 * len(lines[0])), sum(heights))
    panels = figure.subplots(len(heights), len(lines[0]), squeeze=False, height_ratios=heights)
    for row, line in zip(panels, lines, strict=False):
        for axes, condition in zip(row, line, strict=False):
            _plot_rows(axes, rows, condition)
            axes.tick_params(labelleft=axes is row[0])
        for axes in row[len(line) :]:
            axes.set_visible(False)
    if costs:
        panels[-1][0].set_ylabel(SUCCESS)
        for axes, condition in zip(panels[-1], lines[0], strict=True):
            _plot_costs(axes, rows, condition)


def validated(row: SweepRow) -> Points:
    """Sum the closed-loop validations of all cells; empty if there were none."""
    points: Points = {}
    for run in row.runs:
        played = at(run.config, "validate.episodes", 0)
        if not isinstance(played, int) or played < 1:
            continue
        for step, share in zip(*run.metrics.get("val/success", ((), ())), strict=True):
            won, others = points.get(int(step) + 1, (0, 0))
            points[int(step) + 1] = won + round(share * played), others + played
    return points


def _lines(rows: list[SweepRow]) -> dict[str, list[SweepRow]]:
    """Group rows by their other choices, sorted by the number of demonstrations."""
    lines: dict[str, list[SweepRow]] = {}
    for row in sorted(rows, key=_demonstrations):
        lines.setdefault(" ".join(value for key, value in row.choices.items() if key != DEMONSTRATIONS), []).append(row)
    return lines


def _demonstrations(row: SweepRow) -> int:
    choice = row.choices[DEMONSTRATIONS]  # "default" in a cell of another sweep in the folder
    return int(choice) if choice.isdecimal() else int(at(row.runs[0].config, DEMONSTRATIONS, 0))


def _plot_curves(axes: Axes, lines: dict[str, list[SweepRow]], condition: str) -> None:
    """Plot success under one condition over the number of demonstrations."""
    for name, line in lines.items():
        played = [row for row in line if condition in row.played]
        rates, reach = error_bars(row.interval(condition) for row in played)
        counts = [_demonstrations(row) for row in played]
        axes.errorbar(counts, rates, reach, fmt="o-", capsize=3, label=name, clip_on=False)
    _label_rates(axes, condition, "demonstrations")
    axes.set_xticks(sorted({_demonstrations(row) for line in lines.values() for row in line}))


def _plot_training(axes: Axes, name: str, curves: dict[str, Points], counts: list[int]) -> None:
    """Plot success in validation over training steps, one line per number of demonstrations."""
    for demonstrations, points in curves.items():
        colour = colormaps["viridis_r"]((counts.index(int(demonstrations)) + 1) / len(counts))
        shares = np.array([(won / played, *wilson_interval(won, played)) for won, played in points.values()])
        rates, low, high = shares.reshape(-1, 3).T
        axes.plot(list(points), rates, "o-", color=colour, markersize=4, label=demonstrations, clip_on=False)
        axes.fill_between(list(points), low, high, color=colour, alpha=0.1, linewidth=0)
    axes.set_ylim(0, 1)
    axes.set_xlabel("training steps")
    axes.set_title(", ".join(filter(None, (name, "in validation"))), fontsize=10)


def _plot_rows(axes: Axes, rows: list[SweepRow], condition: str) -> None:
    """Plot success of every row under one condition, with a vertical line at the first row."""
    for height, row in enumerate(rows):
        if condition in row.played:
            rate, reach = error_bars([row.interval(condition)])
            axes.errorbar(rate, height, xerr=reach, fmt="o", color=f"C{height}", capsize=3, clip_on=False)
    if condition in rows[0].played:
        axes.axvline(rows[0].interval(condition)[0], color="C0", linewidth=0.8, linestyle=":")
    sizes = [f", {row.parameters / 1e6:.2f} M" if row.parameters else "" for row in rows]
    axes.set_yticks(range(len(rows)), [row.name + size for row, size in zip(rows, sizes, strict=True)])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(0, 1)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "", "0.5", "", "1"])
    axes.set_xlabel(SUCCESS)
    axes.set_title(condition.replace("_", " "), fontsize=10)


def _plot_costs(axes: Axes, rows: list[SweepRow], condition: str) -> None:
    """Plot success over the time per action with the Pareto front; the area of a point grows with the parameters."""
    for number, row in enumerate(rows):
        if condition in row.played and row.latencies:
            rate, reach = error_bars([row.interval(condition)])
            area = 40 + 60 * (row.parameters / 1e6) ** 0.5
            axes.errorbar(row.latency, rate, reach, color="#c4c8ce", capsize=3, zorder=1, clip_on=False)
            axes.scatter(row.latency, rate, s=area, color=f"C{number}", alpha=0.9, clip_on=False)
    best = pareto(rows, condition)
    rates = [row.interval(condition)[0] for row in best]
    axes.plot([row.latency for row in best], rates, color=GREY, linewidth=0.8, zorder=0)
    _label_rates(axes, condition, "time per action [ms]")
    latencies = [row.latency for row in rows if row.latencies]
    axes.set_xlim(0.7 * min(latencies), 1.4 * max(latencies))
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))


def _label_rates(axes: Axes, condition: str, label: str) -> None:
    """Prepare axes for success rates under a condition, 0…1, over a logarithmic axis."""
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_ylim(0, 1)
    axes.set_xlabel(label)
    axes.set_title(condition.replace("_", " "), fontsize=10, pad=10)  # above the points at 1


def pareto(rows: list[SweepRow], condition: str) -> list[SweepRow]:
    """Return the Pareto front of success under a condition and time per action, fastest first."""

    def rate(row: SweepRow) -> float:
        return row.interval(condition)[0]

    best: list[SweepRow] = []
    played = [row for row in rows if condition in row.played and row.latencies]
    for row in sorted(played, key=lambda row: (row.latency, -rate(row))):
        if not best or rate(row) > rate(best[-1]):
            best.append(row)
    return best
