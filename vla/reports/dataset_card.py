"""The card of an episode store: a table for the terminal, and `card.md` and `card.png` in its folder."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vla.data.episode_filter import flat, leaves
from vla.data.index import NOT_NEEDED, Entry, listed
from vla.data.verification import StoreReport, entries_by_config, episode_of
from vla.io.files import write_text
from vla.reports.factors import numeric
from vla.reports.observations import reset_panels, spans
from vla.reports.pictures import BLUE, GREEN, RED, Panels, plot_counts, save
from vla.reports.tables import Table, in_brackets
from vla.spec import Array

WORDS, SENTENCES = 8, 12  # maximum number of bars for words and for instructions
FRAMES, COLUMNS = 4, 4  # episodes whose first images are shown, panels per row


def store_table(findings: StoreReport) -> Table:
    """Describe a store: its episodes, what they hold, and how large it is."""
    store, spec = findings.store, findings.store.spec
    lengths = [entry.steps for entry in findings.whole] or [0]
    tried = [entry.seed for entry in store.tried if entry.outcome != NOT_NEEDED]
    instructions = _most([entry.instruction for entry in findings.whole], SENTENCES)
    rows = {
        "episodes": f"{len(findings.whole)} intact, of {len(tried)} seeds tried: {listed(tried)}",
        "steps": f"{sum(lengths)}, from {min(lengths)} to {max(lengths)} in an episode",
        "time": f"{60 * findings.hours:.1f} min at {spec.control_hz:g} Hz",
    }
    if not store.derived and not all("recorded" in entry.draws for entry in findings.whole):  # else it is meaningless
        rows["success rate"] = f"{100 * findings.success_rate:.1f} %"
    rows["outcomes"] = "\n".join(f"{count} {name}" for name, count in findings.outcomes.items())
    rows["instructions"] = "\n".join(f"{count} {words}" for words, count in instructions.items())
    for name, size in findings.sizes.items():
        shape, dtype = store.fields[name]
        rows[name] = f"{size / 1e6:.1f} MB, {dtype.name} {' x '.join(map(str, shape))} per step"
    rows["all fields"] = f"{sum(findings.sizes.values()) / 1e6:.1f} MB"
    rows["cameras"] = f"{', '.join(spec.cameras)}: {spec.image_size[0]} x {spec.image_size[1]} px"
    return Table(("", store.folder.name), [*rows.items()])


def write_card(findings: StoreReport) -> Path:
    """Write `card.md` and `card.png` into the folder of a store with intact episodes; return the path of `card.md`."""
    assert findings.whole, "no episode is intact"
    folder = findings.store.folder
    save(folder / "card.png", _panels(findings), COLUMNS, (4, 1.9), f"{len(findings.whole)} episodes")
    write_text(folder / "card.md", _text(findings))
    return folder / "card.md"


def _text(findings: StoreReport) -> str:
    store, spec, action = findings.store, findings.store.spec, findings.actions.astype(np.float64)
    numbers = zip(spec.low, spec.high, action.mean(0), action.std(0), strict=True)
    components = [
        (name, unit, *(f"{each:.4g}" for each in four))
        for name, unit, four in zip(spec.action, spec.units, numbers, strict=True)
    ]
    chosen = [f"Chosen by `inspect.where={condition}`.\n" for condition in store.config.get("where", ())]
    configs = [
        f"{len(entries)} seeds, {listed([entry.seed for entry in entries])}:\n\n```json\n"
        f"{json.dumps(config, indent=1, ensure_ascii=False)}\n```\n"
        for config, entries in entries_by_config(store)
    ]
    frame = f" in frame {spec.robot.frame}" if spec.robot else ""
    heads = ("action", "unit", "minimum", "maximum", "mean", "standard deviation")
    paragraphs = [
        f"# {store.folder.name}\n",
        "![First frames, outcomes, actions and draws](card.png)\n",
        store_table(findings).markdown(),
        "## One step\n",
        Table(("state", "unit"), [*zip(spec.state, spec.state_units, strict=True)]).markdown(),
        f"`action` is the label to imitate, `executed` was sent to the robot{frame}:\n",
        Table(heads, components).markdown(),
        "## Draws\n",
        Table(("draw", "range"), [*spans([_draws(findings.whole)]).items()]).markdown(),
        "## Configuration\n",
        *chosen,
        *configs,
        "Training on this store, with the task and the expert above on the command line:\n",
        f"```\npython -m vla.run job=train collect.folder=FOLDER collect.episodes={len(findings.whole)}\n```\n",
    ]
    return "\n".join(paragraphs)


def _draws(entries: Sequence[Entry]) -> dict[str, list[Any]]:
    """Return dotted name → values of a draw over the episodes, without the instruction, which has its own panel."""
    drawn: dict[str, list[Any]] = {}
    for entry in entries:
        for name, value in flat(entry.draws).items():
            if value != entry.instruction:
                drawn.setdefault(name, []).append(value)
    return drawn


def _most(values: Sequence[str], words: int = WORDS) -> dict[str, int]:
    """Return the most frequent values and their counts, with one entry for all others."""
    counts = Counter(values)
    shown = dict(counts.most_common(words))
    others = len(counts) - len(shown)
    return shown if not others else {**shown, f"({others} others)": counts.total() - sum(shown.values())}


def _panels(findings: StoreReport) -> Panels:
    """Return panels of first images, outcomes, lengths, instructions, action labels and draws."""
    entries, spec = findings.whole, findings.store.spec
    shown = [entries[place] for place in sorted({*np.linspace(0, len(entries) - 1, FRAMES).round().astype(int)})]
    first = [replace(episode_of(findings.store, entry).observations[0], depth={}) for entry in shown]
    panels = reset_panels([entry.seed for entry in shown], first)
    outcomes, instructions = findings.outcomes, _most([entry.instruction for entry in entries], SENTENCES)
    colours = [GREEN if name == "success" else RED for name in outcomes]
    panels["outcomes of all seeds"] = partial(plot_counts, counts=outcomes, colours=colours)
    panels["length of episodes [steps]"] = partial(_plot_values, values=[entry.steps for entry in entries])
    panels["instructions"] = partial(plot_counts, counts=instructions, colours=[BLUE])
    for index, name in enumerate(spec.action):
        bins = np.linspace(spec.low[index], spec.high[index], 42)
        # A limit in float32 can lie outside the bins.
        labels = np.clip(findings.actions[:, index], bins[0], bins[-1])
        panels[name + in_brackets(spec.units[index])] = partial(_plot_labels, labels=labels, bins=bins)
    for name, values in _draws(entries).items():
        if len({str(value) for value in values}) > 1:
            panels[name] = partial(_plot_values, values=values)
    return panels


def _plot_labels(axes: Axes, labels: Array, bins: Array) -> None:
    axes.locator_params(axis="x", nbins=5)
    axes.hist(labels, bins, color=BLUE, log=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")


def _plot_values(axes: Axes, values: Sequence[Any]) -> None:
    """Plot counts of words, a scatter plot of pairs, or a histogram of all else."""
    items = leaves(values)
    if not numeric(items):
        plot_counts(axes, _most([*map(str, items)]), [BLUE])
    elif all(map(_is_pairs, values)):
        across, along = np.reshape(items, (-1, 2)).T
        axes.scatter(across, along, s=10, c=BLUE, alpha=0.5, linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.locator_params(axis="x", nbins=5)
        axes.hist(items, int(np.clip(np.sqrt(len(items)), 8, 32)), color=BLUE)


def _is_pairs(value: Any) -> bool:
    return isinstance(value, list) and ((len(value) == 2 and numeric(value)) or all(map(_is_pairs, value)))
