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

from vla.data.episode_filter import flatten, leaves
from vla.data.index import NOT_NEEDED, format_numbers
from vla.data.verification import StoreReport, entries_by_config, episode_of
from vla.io.errors import counted
from vla.io.files import write_text
from vla.reports.factors import are_numeric
from vla.reports.observations import reset_panels, spans
from vla.reports.pictures import BLUE, GREEN, RED, Panels, plot_counts, save
from vla.reports.tables import Table, unit_suffix
from vla.spec import Array

WORDS = 12  # maximum number of bars for words and for instructions
FRAMES, COLUMNS = 4, 4  # episodes whose first images are shown, panels per row
MAX_DRAW_PANELS = 200  # maximum number of panels of draws


def store_table(findings: StoreReport) -> Table:
    """Describe a store: its episodes, what they hold, and how large it is."""
    store, spec = findings.store, findings.store.spec
    lengths = [entry.steps for entry in findings.intact_entries] or [0]
    seeds = [entry.seed for entry in store.attempts if entry.outcome != NOT_NEEDED]
    instructions = _most_frequent([entry.instruction for entry in findings.intact_entries])
    rows = {
        "episodes": f"{len(findings.intact_entries)} intact, of {counted(len(seeds), 'seed')} tried: "
        f"{format_numbers(seeds)}",
        "steps": f"{sum(lengths)}, from {min(lengths)} to {max(lengths)} in an episode",
        "time": f"{60 * findings.hours:.1f} min at {spec.control_hz:g} Hz",
    }
    # Else it is meaningless.
    if not store.is_derived and not all("recorded" in entry.draws for entry in findings.intact_entries):
        rows["success rate"] = f"{100 * findings.success_rate:.1f} %"
    for name, counts in (("outcomes", findings.outcomes), ("instructions", instructions)):
        rows[name] = "\n".join(f"{count} {words}" for words, count in counts.items())
    for name, size in findings.sizes.items():
        shape, dtype = store.fields[name].shape, store.fields[name].dtype
        rows[name] = f"{size / 1e6:.1f} MB, {dtype.name} {' x '.join(map(str, shape))} per step"
    rows["all fields"] = f"{sum(findings.sizes.values()) / 1e6:.1f} MB"
    rows["cameras"] = f"{', '.join(spec.cameras)}: {spec.image_size[0]} x {spec.image_size[1]} px"
    return Table(("", store.folder.name), [*rows.items()])


def write_card(findings: StoreReport) -> Path:
    """Write `card.md` and `card.png` into the folder of a store with intact episodes; return the path of `card.md`."""
    folder = findings.store.folder
    save(folder / "card.png", _panels(findings), COLUMNS, (4, 1.9), counted(len(findings.intact_entries), "episode"))
    write_text(folder / "card.md", _text(findings))
    return folder / "card.md"


def _text(findings: StoreReport) -> str:
    store, spec, action = findings.store, findings.store.spec, findings.actions.astype(np.float64)
    numbers = np.array([action.min(0), action.max(0), action.mean(0), action.std(0)]).T  # (D, 4)
    heads = ("action", "unit", "minimum", "maximum", "mean", "standard deviation")
    rows = zip(spec.action, spec.units, numbers, strict=True)
    draws = spans([entry.draws for entry in findings.intact_entries]).items()
    parts = [
        f"# {store.folder.name}\n\n![First frames, outcomes, actions and draws](card.png)\n",
        store_table(findings).markdown(),
        Table(("state", "unit"), [*zip(spec.state, spec.state_units, strict=True)]).markdown(),
        Table(heads, [[name, unit, *(f"{value:.4g}" for value in values)] for name, unit, values in rows]).markdown(),
        Table(("draw", "range"), [*draws]).markdown(),
        *(f"Chosen by `inspect.where={condition}`.\n" for condition in store.config.get("where", ())),
    ]
    for config, entries in entries_by_config(store):
        content = json.dumps(config, indent=1, ensure_ascii=False)
        seeds = [entry.seed for entry in entries]
        parts.append(f"{counted(len(seeds), 'seed')}, {format_numbers(seeds)}:\n\n```json\n{content}\n```\n")
    return "\n".join(parts)


def _most_frequent(values: Sequence[str]) -> dict[str, int]:
    """Return the most frequent values and their counts, with one entry for all others."""
    counts = Counter(values)
    top = dict(counts.most_common(WORDS))
    rest = len(counts) - len(top)
    return top if not rest else {**top, f"({counted(rest, 'other')})": counts.total() - sum(top.values())}


def _panels(findings: StoreReport) -> Panels:
    """Return panels of first images, outcomes, lengths, instructions, action labels, and the draws that vary."""
    entries, spec = findings.intact_entries, findings.store.spec
    sample = [entries[place] for place in sorted({*np.linspace(0, len(entries) - 1, FRAMES).round().astype(int)})]
    observations = [replace(episode_of(findings.store, entry).observations[0], depth={}) for entry in sample]
    panels = reset_panels([entry.seed for entry in sample], observations)
    colours = [GREEN if name == "success" else RED for name in findings.outcomes]
    panels["outcomes of all seeds"] = partial(plot_counts, counts=findings.outcomes, colours=colours)
    panels["length of episodes [steps]"] = partial(_plot_values, values=[entry.steps for entry in entries])
    panels["instructions"] = partial(_plot_values, values=[entry.instruction for entry in entries])
    for index, name in enumerate(spec.action):
        labels = findings.actions[:, index]
        panels[name + unit_suffix(spec.units[index])] = partial(_plot_numbers, values=labels, log=True)
    draws: dict[str, list[Any]] = {}
    for entry in entries:
        for name, value in flatten(entry.draws).items():
            draws.setdefault(name, []).append(value)
    varied = {name: values for name, values in draws.items() if len({str(value) for value in values}) > 1}
    shown_draws = [*varied.items()][:MAX_DRAW_PANELS]
    return panels | {name: partial(_plot_values, values=values) for name, values in shown_draws}


def _plot_values(axes: Axes, values: Sequence[Any]) -> None:
    """Plot counts of words, a scatter plot of pairs, or a histogram of all else."""
    items = leaves(values)
    if not are_numeric(items):
        plot_counts(axes, _most_frequent([*map(str, items)]), [BLUE])
    elif all(isinstance(value, list) and len(value) == 2 and are_numeric(value) for value in values):
        axes.scatter(*np.transpose(values), s=10, c=BLUE, alpha=0.5, linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
    else:
        _plot_numbers(axes, np.array(items))


def _plot_numbers(axes: Axes, values: Array, log: bool = False) -> None:
    """Plot a histogram of numbers (N,), perhaps with a logarithmic axis."""
    axes.locator_params(axis="x", nbins=5)
    values = np.asarray(values, np.float64)
    low, high = values.min(), values.max()
    if high - low < 1e-6 * max(1.0, abs(low), abs(high)):  # nothing but rounding, too little for bins
        low, high = low - 0.5, high + 0.5
    axes.hist(values, int(np.clip(np.sqrt(len(values)), 8, 40)), (low, high), color=BLUE, log=log)
