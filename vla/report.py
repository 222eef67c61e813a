"""What an evaluation leaves behind, report.json and a page of plots, and what a preview shows of resets."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from vla.evaluate import ERROR, Report, Result
from vla.factors import association, factors, groups, numeric
from vla.files import write_text
from vla.intervals import wilson_interval
from vla.spec import Array, Observation, flat, leaves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from PIL import Image

GREEN, RED, BLUE, GREY = "#2e9e5b", "#d2483f", "#3b76c4", "#8a8f98"
PANELS = 8  # drawn factors on the page
TILE = 144  # smallest height of an image on a contact sheet [px]
CAPTION = 18  # height of a line of text on it [px]


def write_report(
    report: Report,
    path: Path,
    checkpoint: str | None,
    config: Mapping[str, Any],
    facts: Mapping[str, Any] | None = None,
    conditions: Mapping[str, Report] | None = None,
) -> None:
    """Write a report as JSON, all of it or nothing: rate and interval, outcomes, what was evaluated, every episode.

    `facts` say what was evaluated: which options were chosen, how large and fast the policy is, what it took;
    `conditions` are reports on the same seeds, by name.
    """
    content = {
        **summary(report),
        "seeds": [result.seed for result in report.results],
        "checkpoint": checkpoint,
        **(facts or {}),
        "conditions": {
            name: {**summary(other), "outcomes": [result.outcome for result in other.results]}
            for name, other in (conditions or {}).items()
        },
        "config": config,
        "per_episode": [asdict(result) for result in report.results],
    }
    write_text(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def summary(report: Report) -> dict[str, Any]:
    """Rate, interval and outcomes of a report, and of every goal if there are several, fit for JSON."""
    low, high = report.interval
    goals = report.goals if len(report.goals) > 1 else {}
    return {
        "success": report.success,
        "ci_low": low,
        "ci_high": high,
        "episodes": report.episodes,
        "successes": report.successes,
        "errors": len(report.errors),
        "taken": report.taken,
        "taxonomy": report.taxonomy,
        "goals": {goal: summary(part) for goal, part in goals.items()},
    }


def plot_report(report: Report, path: Path) -> None:
    """Draw one page: success with its interval, outcomes, lengths of episodes, and success over what was drawn.

    The drawn factors over which success varies most, compared with chance, come first.
    """
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    played = [result for result in report.results if result.outcome != ERROR]
    shown = sorted(factors(played).items(), key=lambda factor: -association(factor[1], played))[:PANELS]
    rows = 1 + -(-len(shown) // 4)
    figure = Figure(figsize=(13, 3.1 * rows), layout=ConstrainedLayoutEngine(h_pad=0.12))
    figure.suptitle(str(report).splitlines()[-1], fontsize=15, fontweight="bold")
    grid = figure.add_gridspec(rows, 4)
    _plot_outcomes(figure.add_subplot(grid[0, :2]), report)
    _plot_lengths(figure.add_subplot(grid[0, 2:]), played)
    for index, (name, values) in enumerate(shown):
        axes = figure.add_subplot(grid[1 + index // 4, index % 4])
        axes.set_title(name, fontsize=10)
        plot = _plot_points if isinstance(values[0], tuple) else _plot_groups
        plot(axes, values, played)
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def _plot_outcomes(axes: Axes, report: Report) -> None:
    """One bar per outcome, the success bar with its interval."""
    names, counts = list(report.taxonomy)[::-1], list(report.taxonomy.values())[::-1]
    colours = [GREEN if name == "success" else GREY if name == ERROR else RED for name in names]
    axes.barh([name.replace("_", " ") for name in names], counts, color=colours, height=0.7)
    low, high = (bound * report.episodes for bound in report.interval)
    for row, (name, count) in enumerate(zip(names, counts, strict=True)):
        axes.annotate(
            str(count), (high if name == "success" else count, row), (6, 0), textcoords="offset points", va="center"
        )
        if name == "success":
            axes.plot([low, high], [row, row], color="black", linewidth=1.5, marker="|", markersize=10)
    axes.set_xlim(0, 1.1 * len(report.results))
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel("episodes")
    axes.set_title("outcomes", fontsize=10, loc="left")


def _plot_lengths(axes: Axes, played: Sequence[Result]) -> None:
    """Steps until success or failure."""
    steps = [[result.steps for result in played if (result.outcome == "success") == good] for good in (True, False)]
    edges = np.histogram_bin_edges(steps[0] + steps[1] or [0], bins=30)
    axes.hist(steps, bins=list(edges), stacked=True, color=[GREEN, RED], label=["success", "failure"])
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    axes.set_xlabel("steps")
    axes.locator_params(axis="y", integer=True)
    axes.set_ylabel("episodes")
    axes.set_title("length of episodes", fontsize=10, loc="left")


def _plot_points(axes: Axes, values: Sequence[tuple[float, float]], played: Sequence[Result]) -> None:
    """Where in the plane it succeeds and where it fails; failures on top."""
    for good, colour, marker in ((True, GREEN, "o"), (False, RED, "X")):
        points = [value for value, result in zip(values, played, strict=True) if (result.outcome == "success") == good]
        across, along = np.array(points).reshape(-1, 2).T
        axes.scatter(across, along, c=colour, marker=marker, s=22, alpha=0.75, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")


def _plot_groups(axes: Axes, values: Sequence[Any], played: Sequence[Result]) -> None:
    """Success rate with its interval in each group of values; a group of numbers stands at its mean."""
    split = groups(values)
    if numeric(values):
        places = [float(np.mean([values[index] for index in group])) for group in split]
        axes.locator_params(axis="x", nbins=4)  # more would run into each other where numbers are long
    else:
        places = list(range(len(split)))
        names = [str(values[group[0]]) for group in split]
        tilt = 20 if max(map(len, names)) > 9 else 0
        axes.set_xticks(places, names, fontsize=8, rotation=tilt, ha="right" if tilt else "center")
        axes.set_xlim(-0.5, len(split) - 0.5)
    won = [sum(played[index].outcome == "success" for index in group) for group in split]
    rates = np.array([good / len(group) for good, group in zip(won, split, strict=True)])
    bounds = np.array([wilson_interval(good, len(group)) for good, group in zip(won, split, strict=True)])
    reach = np.abs(bounds.T - rates)
    axes.errorbar(places, rates, reach, fmt="o-", color=GREEN, ecolor=GREY, linewidth=0.7, capsize=3, clip_on=False)
    axes.set_ylim(0, 1)
    axes.set_ylabel("success")
    axes.grid(axis="y", alpha=0.3)


def contact_sheet(seeds: Sequence[int], observations: Sequence[Observation], columns: int = 2) -> Image.Image:
    """What the cameras see right after resets, on one picture.

    One block per reset, captioned with its seed and instruction: each camera's colours, then each camera's depth,
    from near (blue) to far (red) in the same range for all resets. Pixels are enlarged, never blended.
    """
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    turbo = matplotlib.colormaps["turbo"]
    ranges = {name: _depth_range([seen.depth[name] for seen in observations]) for name in observations[0].depth}
    blocks = []
    for seen in observations:
        depth = [turbo(np.clip((seen.depth[name] - low) / (high - low), 0, 1)) for name, (low, high) in ranges.items()]
        tiles = [*seen.rgb.values(), *((255 * shades[..., :3]).astype(np.uint8) for shades in depth)]
        factor = max(1, -(-TILE // len(tiles[0])))
        blocks.append(np.concatenate([_framed(tile.repeat(factor, 0).repeat(factor, 1)) for tile in tiles], axis=1))
    height, width = blocks[0].shape[0] + CAPTION, blocks[0].shape[1] + CAPTION
    rows = -(-len(blocks) // columns)
    sheet = Image.new("RGB", (columns * width + CAPTION, rows * (height + CAPTION // 2) + 2 * CAPTION), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for index, (seed, seen, block) in enumerate(zip(seeds, observations, blocks, strict=True)):
        left, top = CAPTION + index % columns * width, CAPTION // 2 + index // columns * (height + CAPTION // 2)
        draw.text((left, top), f"seed {seed}: {seen.instruction}", fill="black", font=font)
        sheet.paste(Image.fromarray(block), (left, top + CAPTION))
    legend = [f"{name} depth {low / 1000:.2f}-{high / 1000:.2f} m" for name, (low, high) in ranges.items()]
    names = ", ".join([f"{name} colour" for name in observations[0].rgb] + legend)
    draw.text((CAPTION, sheet.height - CAPTION - 4), f"from left to right: {names}", fill="black", font=font)
    return sheet


def _depth_range(images: Sequence[Array]) -> tuple[float, float]:
    """Near and far [mm], without the few extreme pixels and without those that got no return."""
    depth = np.stack(images)
    low, high = np.percentile(depth[depth > 0], (1, 90)) if depth.any() else (0.0, 1.0)
    return float(low), float(max(high, low + 1.0))


def _framed(tile: Array) -> Array:
    return np.pad(tile, ((0, 4), (0, 4), (0, 0)), constant_values=255)


def draws_table(seeds: Sequence[int], draws: Sequence[Mapping[str, Any]]) -> Table:
    """What was drawn in several resets: the range of every draw, or the words in it, and the first reset's values."""
    table = Table("draw", "range", f"seed {seeds[0]}", title=f"{len(draws)} resets")
    first = flat(draws[0])
    for name, seen in spans(draws).items():
        values = [f"{leaf:.3g}" if isinstance(leaf, float) else str(leaf) for leaf in leaves(first.get(name))]
        table.add_row(name, seen, " ".join(values))
    return table


def spans(draws: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Dotted name → the range of everything drawn under that name, or the words in it."""
    seen: dict[str, list[Any]] = {}
    for draw in draws:
        for name, value in flat(draw).items():
            seen.setdefault(name, []).extend(leaves(value))
    return {
        name: f"{min(values):.4g} … {max(values):.4g}"
        if values and all(isinstance(value, (int, float)) for value in values)
        else ", ".join(sorted({str(value) for value in values}))
        for name, values in seen.items()
    }
