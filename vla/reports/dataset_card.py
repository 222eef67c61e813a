"""The card of an episode store: a table for the terminal, and `card.md` and `card.png` in its folder."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from rich.markup import escape
from rich.table import Table

from vla.data.episode_filter import flat
from vla.data.index import NOT_NEEDED, Entry, listed
from vla.data.verification import StoreReport, entries_by_config, episode_of
from vla.io.files import write_text
from vla.reports.resets import contact_sheet, spans
from vla.reports.style import BLUE, GREEN, RED, markdown_table, save
from vla.spec import Spec, in_brackets

ITEMS = (RED, GREEN, BLUE)  # colours of a triple's items
WORDS, SENTENCES = 8, 12  # maximum number of bars for words and for instructions
FRAMES = 4  # episodes on the contact sheet
WIDTH = 1600  # approximate width of the page [px]
DPI = 100
COLUMNS = 6  # panels of draws per row
TITLE, GAP, OUTCOMES, ACTIONS, DRAWS = 50, 12, 270, 230, 170  # heights on the page [px], of draws per row


def store_table(findings: StoreReport) -> Table:
    """Describe a store in a table for the terminal."""
    store, spec = findings.store, findings.store.spec
    lengths = [entry.steps for entry in findings.whole] or [0]
    tried = [entry.seed for entry in store.tried if entry.outcome != NOT_NEEDED]
    table = Table(title=escape(str(store.folder)), show_header=False)
    table.add_row("episodes", f"{len(findings.whole)} intact, of {len(tried)} seeds tried: {listed(tried)}")
    table.add_row("steps", f"{sum(lengths)}, from {min(lengths)} to {max(lengths)} in an episode")
    table.add_row("time", _time(findings))
    if not store.derived and not _imported(findings):  # meaningless for selected episodes
        table.add_row("success rate", f"{100 * findings.success_rate:.1f} %")
    table.add_row("outcomes", "\n".join(f"{count} {escape(name)}" for name, count in findings.outcomes.items()))
    table.add_section()
    instructions = _most(_instructions(findings), SENTENCES)
    table.add_row("instructions", "\n".join(f"{count} {escape(words)}" for words, count in instructions.items()))
    table.add_section()
    for name, size in findings.sizes.items():
        shape, dtype = store.fields[name]
        table.add_row(name, f"{_bytes(size)}, {dtype.name} {' x '.join(map(str, shape))} per step")
    table.add_row("all fields", _bytes(sum(findings.sizes.values())))
    table.add_section()
    height, width = spec.image_size
    table.add_row("cameras", f"{', '.join(spec.cameras)}: {height} x {width} px")
    table.add_row("state", ", ".join(spec.state))
    table.add_row("action", f"{', '.join(spec.action)}{_frame(spec)}")
    return table


def write_card(findings: StoreReport) -> Path:
    """Write `card.md` and `card.png` into the store's folder atomically, and return the path of `card.md`.

    At least one episode must be intact. The content is deterministic.
    """
    assert findings.whole, "no episode is intact"
    folder = findings.store.folder
    save(_page(findings), folder / "card.png", DPI)
    write_text(folder / "card.md", _text(findings))
    return folder / "card.md"


def _summary(findings: StoreReport) -> str:
    store = findings.store
    rate = f"; success on {100 * findings.success_rate:.1f} % of the seeds tried"
    rate = "" if store.derived or _imported(findings) else rate
    return f"{len(findings.whole)} episodes, {len(findings.actions)} steps, {_time(findings)}{rate}"


def _imported(findings: StoreReport) -> bool:
    """Return whether the episodes are recordings, which all count as successes."""
    return all("recorded" in entry.draws for entry in findings.whole)


def _time(findings: StoreReport) -> str:
    hours = findings.hours
    return f"{f'{hours:.2f} h' if hours >= 1 else f'{60 * hours:.1f} min'} at {findings.store.spec.control_hz:g} Hz"


def _text(findings: StoreReport) -> str:
    store, spec = findings.store, findings.store.spec
    fields = [(name, *store.fields[name], size) for name, size in findings.sizes.items()]
    action = findings.actions.astype(np.float64)
    moments = [[f"{number:.4g}" for number in numbers] for numbers in zip(action.mean(0), action.std(0), strict=True)]
    components = zip(spec.action, spec.units, spec.low, spec.high, *zip(*moments, strict=True), strict=True)
    conditions = [f"Chosen by `inspect.where={condition}`." for condition in store.config.get("where", ())]
    configs = [
        f"{len(entries)} seeds, {listed([entry.seed for entry in entries])}:\n\n```json\n"
        f"{json.dumps(config, indent=1, ensure_ascii=False)}\n```"
        for config, entries in entries_by_config(store)
    ]
    paragraphs = [
        f"# {store.folder.name}",
        f"{_summary(findings)}.",
        "![First frames, outcomes, actions and draws](card.png)",
        "## Outcomes",
        markdown_table(("outcome", "seeds"), findings.outcomes.items()),
        "## Instructions",
        markdown_table(("instruction", "episodes"), _instructions(findings).most_common()),
        "## One step",
        markdown_table(("field", "shape", "type", "total bytes"), fields),
        markdown_table(("component of the state", "unit"), zip(spec.state, spec.state_units, strict=True)),
        *(["Depth is in mm."] if spec.depth else []),
        f"`action` is the label to imitate, `executed` was sent to the robot{_frame(spec)}:",
        markdown_table(("component", "unit", "minimum", "maximum", "mean", "standard deviation"), components),
        "## Draws",
        markdown_table(("draw", "range"), spans([_draws(findings.whole)]).items()),
        "## Configuration",
        *conditions,
        *configs,
        "## Training on this store",
        "With the task and the expert above on the command line:",
        f"```\npython -m vla.run job=train collect.folder=FOLDER collect.episodes={len(findings.whole)}\n```",
    ]
    return "\n\n".join(each.strip() for each in paragraphs) + "\n"


def _frame(spec: Spec) -> str:
    return f" in frame {spec.robot.frame}" if spec.robot else ""


def _instructions(findings: StoreReport) -> Counter[str]:
    return Counter(entry.instruction for entry in findings.whole)


def _most(counts: Counter[str], words: int = WORDS) -> dict[str, int]:
    """Return the most frequent items and their counts, with one entry for all others."""
    shown = dict(counts.most_common(words))
    others = len(counts) - len(shown)
    return shown if not others else {**shown, f"({others} others)": counts.total() - sum(shown.values())}


def _draws(entries: Sequence[Entry]) -> dict[str, list[Any]]:
    """Return dotted name → values of a draw over the episodes, without the instruction, which has its own panel."""
    drawn: dict[str, list[Any]] = {}
    for entry in entries:
        for name, value in flat(entry.draws).items():
            if value != entry.instruction:
                drawn.setdefault(name, []).append(value)
    return drawn


def _bytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"


def _page(findings: StoreReport) -> Figure:
    """Draw the page of plots."""
    entries = findings.whole
    shown = [entries[place] for place in sorted({*np.linspace(0, len(entries) - 1, FRAMES).round().astype(int)})]
    first = [episode_of(findings.store, entry).observations[0] for entry in shown]
    block = contact_sheet([shown[0].seed], first[:1], columns=1).width
    sheet = contact_sheet([entry.seed for entry in shown], first, columns=max(1, round(WIDTH / block)))
    draws = {name: values for name, values in _draws(entries).items() if len({str(value) for value in values}) > 1}
    rows = max(1, -(-len(draws) // COLUMNS))
    heights = [TITLE + sheet.height + GAP, OUTCOMES, ACTIONS, DRAWS * rows]
    width, height = max(sheet.width, WIDTH), sum(heights)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.text(18 / width, 1 - 34 / height, _summary(findings), fontsize=15, fontweight="bold")
    figure.figimage(np.array(sheet), 0, height - TITLE - sheet.height)  # pixel for pixel
    _, outcomes, actions, drawn = figure.subfigures(4, 1, squeeze=False, height_ratios=heights)[:, 0]
    _plot_episodes(outcomes, findings)
    _plot_actions(actions, findings)
    for index, (name, values) in enumerate(draws.items()):
        axes = drawn.add_subplot(rows, COLUMNS, index + 1)
        axes.set_title(name, fontsize=9)
        _plot_draw(axes, values)
    parts = (
        (outcomes, OUTCOMES, 0.14, "Episodes"),
        (actions, ACTIONS, 0.16, "Action labels, and executed actions as an outline; number of steps"),
        (drawn, DRAWS * rows, 0.28, "Draws; triples in red, green and blue"),
    )
    for part, size, gap, title in parts:
        # Fixed margins: a layout engine takes as long as drawing the page twice.
        edges = {"left": 55 / width, "right": 1 - 25 / width, "bottom": 28 / size, "top": 1 - 65 / size}
        part.subplots_adjust(**edges, wspace=gap, hspace=0.62)
        part.text(18 / width, 1 - 12 / size, title, va="top", fontsize=11, fontweight="bold")
    for axes in figure.axes:
        axes.tick_params(labelsize=8)
    return figure


def _plot_episodes(figure: SubFigure, findings: StoreReport) -> None:
    """Plot outcomes, episode lengths and instructions."""
    outcomes, lengths, instructions = figure.subplots(1, 3, width_ratios=[2, 3, 4])
    _plot_counts(outcomes, findings.outcomes, [GREEN if name == "success" else RED for name in findings.outcomes])
    outcomes.set_title("outcomes of all seeds", fontsize=10)
    steps = [entry.steps for entry in findings.whole]
    lengths.hist(steps, bins=np.arange(min(steps), max(steps) + 2) - 0.5 if np.ptp(steps) < 60 else 40, color=GREEN)
    lengths.set_title("length of episodes [steps]", fontsize=10)
    _plot_counts(instructions, _most(_instructions(findings), SENTENCES), [BLUE])
    instructions.set_title("instructions", fontsize=10)


def _plot_actions(figure: SubFigure, findings: StoreReport) -> None:
    """Plot a histogram per component of the action labels and of the executed actions."""
    spec = findings.store.spec
    for index, axes in enumerate(np.atleast_1d(figure.subplots(1, len(spec.action), sharey=True))):
        bins = np.linspace(spec.low[index], spec.high[index], 42)
        # A limit in float32 can lie outside the bins.
        labels, executed = (
            np.clip(each[:, index], bins[0], bins[-1]) for each in (findings.actions, findings.executed)
        )
        axes.hist(labels, bins, color=BLUE, log=True)
        axes.hist(executed, bins, color="black", histtype="step", linewidth=0.8, log=True)
        axes.set_title(spec.action[index] + in_brackets(spec.units[index]), fontsize=10)


def _plot_draw(axes: Axes, values: Sequence[Any]) -> None:
    """Plot the draws of one axis: counts of words, a scatter plot of pairs, histograms of all else."""
    rows = [row for value in values for row in _rows(value)]
    items = [item for row in rows for item in row]
    if all(isinstance(item, int) for item in items) and len(set(items)) <= WORDS:
        _plot_counts(axes, {str(item): count for item, count in sorted(Counter(items).items())}, [BLUE])
        return
    if not all(isinstance(item, (int, float)) for item in items):
        _plot_counts(axes, _most(Counter(map(str, items))), [BLUE])
        return
    axes.locator_params(nbins=4)
    widths = {len(row) for row in rows}
    if widths == {2}:
        across, along = np.array(rows).T
        axes.scatter(across, along, s=np.clip(6000 / len(rows), 2, 20), c=BLUE, alpha=0.5, linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
        return
    axes.tick_params(left=False, labelleft=False)
    axes.spines["left"].set_visible(False)
    if widths == {3}:
        for column, colour in zip(np.array(rows).T, ITEMS, strict=True):
            counts, edges = np.histogram(column, _bins(len(column)))
            axes.stairs(counts, edges, fill=True, color=colour, alpha=0.15)
            axes.stairs(counts, edges, baseline=None, color=colour, linewidth=1.2)
        axes.set_ylim(bottom=0)
    else:
        axes.hist(items, _bins(len(items)), color=BLUE)


def _plot_counts(axes: Axes, counts: Mapping[str, int], colours: Sequence[str]) -> None:
    """Plot one labelled bar per word, the first on top, with its count on the right."""
    most = max(counts.values())
    axes.barh(range(len(counts)), list(counts.values()), color=colours, alpha=0.45, height=0.8)
    for row, (name, count) in enumerate(counts.items()):
        axes.text(most / 60, row, name, fontsize=8, va="center", clip_on=True, parse_math=False)
        axes.text(1.2 * most, row, str(count), fontsize=8, va="center", ha="right")
    axes.set_ylim(max(len(counts), 4) - 0.5, -0.5)
    axes.set_xlim(0, 1.2 * most)
    axes.tick_params(left=False, labelleft=False, bottom=False, labelbottom=False)
    axes.spines["bottom"].set_visible(False)


def _rows(value: Any) -> list[list[Any]]:
    """Return the innermost lists of a draw; a single value is a list of one."""
    if not isinstance(value, list):
        return [[value]]
    return [row for item in value for row in _rows(item)] if any(isinstance(item, list) for item in value) else [value]


def _bins(count: int) -> int:
    return int(np.clip(np.sqrt(count), 8, 32))
