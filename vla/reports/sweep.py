"""The table of a sweep, updated after every cell: CSV, Markdown, PNG and HTML."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from rich.markup import escape
from rich.table import Table

from vla.config.differences import ABSENT, at
from vla.io.files import atomic_path, warn_on_error, write_text
from vla.reports.comparison import RunComparison, compare_all_rows, compare_rows, secondary_rows
from vla.reports.conditions import NARROW, comparison_texts
from vla.reports.html import DIFFERENCE, PageTable, difference, in_words, links, rate, render, secondary
from vla.reports.posteriors import FEWEST, MOST, Outcome, draw_posteriors
from vla.reports.style import markdown_table
from vla.reports.sweep_plot import plot
from vla.reports.training_curves import colours, draw_runs
from vla.rollouts.statistics import effective_episodes
from vla.runs.folder import PAGE
from vla.runs.sweep import SweepRow, conditions_of, failures, read_rows
from vla.spec import IN_DISTRIBUTION

SWEEP, OVERVIEW = "sweep.html", "sweep.png"
COSTS = ("each seed [%]", "parameters [M]", "action [ms]")
CONDITIONS = 4  # maximum number of conditions on the console


def tabulate(folder: Path) -> list[SweepRow]:
    """Write the table of a sweep's folder and return its rows; without any report, write nothing."""
    rows = read_rows(folder)
    if rows:
        compared = compare_rows(rows, at(rows[0].runs[0].config, "evaluate.margin", 0.0))
        with atomic_path(folder / "sweep.csv") as draft:
            _write_csv(rows, draft)
        failed = failures(folder)
        write_text(folder / "sweep.md", markdown(rows) + markdown_differences(compared) + markdown_failures(failed))
        plot(rows, folder / OVERVIEW)
        _write_page(rows, compared, failed, folder)
    return rows


def markdown_differences(compared: Sequence[RunComparison]) -> str:
    """Format the differences of all rows from the first in Markdown, below an empty line; nothing without any."""
    if not compared:
        return ""
    head = [f"minus {compared[0].one}", "condition", "points (95 % CI)", "p", "p Holm", "verdict"]
    lines = []
    for each in compared:
        difference, interval, *rest = comparison_texts(each.found)
        lines.append([each.other, each.condition, f"{difference} ({interval})", *rest])
    return "\n" + markdown_table(head, lines)


def markdown_failures(failed: Sequence[str]) -> str:
    """Format the failed cells as a Markdown list, below an empty line; nothing without any."""
    return "\n" + "".join(f"- failed: {line}\n" for line in failed) if failed else ""


def markdown(rows: list[SweepRow]) -> str:
    """Format the table in Markdown: success per condition with its interval, then costs."""
    conditions = conditions_of(rows)
    head = [*rows[0].choices, *(f"{name} [%]" for name in conditions), *COSTS]
    return markdown_table(head, [[*row.choices.values(), *_rates(row, conditions), *_costs(row)] for row in rows])


def console_table(rows: Sequence[SweepRow]) -> Table:
    """Tabulate success and its interval per row and condition; of many conditions only the first."""
    conditions = conditions_of(list(rows))
    shown = conditions if len(conditions) <= CONDITIONS else conditions[:1]
    table = Table(*rows[0].choices, *(f"{name} % (95 % CI)" for name in shown), **NARROW)
    for row in rows:
        table.add_row(*map(escape, row.choices.values()), *_rates(row, shown))
    return table


def _rates(row: SweepRow, conditions: Sequence[str]) -> list[str]:
    """Format success and its interval in percent under each condition."""
    texts = []
    for condition in conditions:
        if condition not in row.played:
            texts.append(ABSENT)
            continue
        rate, low, high = (100 * value for value in row.interval(condition))
        texts.append(f"{rate:.1f} ({low:.1f}-{high:.1f})")
    return texts


def _costs(row: SweepRow) -> list[str]:
    rates = ", ".join(f"{100 * rate:.1f}" for rate in row.rates)
    return [
        rates,
        f"{row.parameters / 1e6:.2f}" if row.parameters else ABSENT,
        f"{row.latency:.1f}" if row.latencies else ABSENT,
    ]


def _write_page(rows: list[SweepRow], compared: Sequence[RunComparison], failed: Sequence[str], folder: Path) -> None:
    """Write the page of a sweep with its tables, plots and training curves."""
    conditions, cells = conditions_of(rows), [run for row in rows for run in row.runs]
    lines = []
    for row in rows:
        rates = [rate(row.interval(each)) if each in row.played else ABSENT for each in conditions]
        pages = links({run.folder.name: f"{quote(run.folder.name)}/{PAGE}" for run in row.runs})
        lines.append([*row.choices.values(), *rates, *_costs(row), pages])
    heads = [*rows[0].choices, *(f"{in_words(name)} [%]" for name in conditions), *COSTS, "cells"]
    captions = [
        ": ".join(filter(None, (run.folder.name, " ".join(row.choices.values())))) for row in rows for run in row.runs
    ]
    pairs = [[each.other, in_words(each.condition), *difference(each.found)] for each in compared]
    title = f"Differences from {compared[0].one}" if compared else ""
    with warn_on_error(folder / SWEEP):
        render(
            folder / SWEEP,
            "sweep.html",
            title=f"Sweep {folder.resolve().name}",
            results=PageTable(heads, lines, "Success and cost"),
            posteriors=_draw_posteriors(rows),
            pairs=PageTable(["row", "condition", *DIFFERENCE], pairs, title),
            secondary=secondary(
                secondary_rows(compared), ("row", "minus", "condition"), "Differences in secondary metrics"
            ),
            anytime=any(report.anytime for run in cells for report in run.reports.values()),
            curves=draw_runs({run.folder.name: run.metrics for run in cells}),
            lines=dict(zip(captions, colours(len(cells)), strict=True)),
            failed=failed,
            overview=folder / OVERVIEW,
        )


def _draw_posteriors(rows: list[SweepRow]) -> str | None:
    """Draw the success of the rows in the colours of the plot; see `draw_posteriors`."""
    if not FEWEST <= len(rows) <= MOST:
        return None
    outcomes = {
        row.name: Outcome(*effective_episodes(row.played[IN_DISTRIBUTION]), row.interval(IN_DISTRIBUTION), f"C{number}")
        for number, row in enumerate(rows)
    }
    return draw_posteriors(outcomes, compare_all_rows(rows))


def _write_csv(rows: list[SweepRow], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        columns = ["condition", "success", "ci_low", "ci_high", "successes", "episodes", "cells"]
        writer.writerow([*rows[0].choices, *columns, "parameters", "latency_ms"])
        for row in rows:
            for condition in row.played:
                counts = [row.successes[condition], row.episodes[condition], len(row.rates)]
                costs = [row.parameters or "", round(row.latency, 3) if row.latencies else ""]
                writer.writerow([*row.choices.values(), condition, *row.interval(condition), *counts, *costs])
