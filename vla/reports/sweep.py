"""The table of a sweep, updated after every cell: CSV, Markdown, PNG and HTML."""

from __future__ import annotations

import csv
from pathlib import Path

from vla.config.differences import at
from vla.io.files import atomic_path, warn_on_error, write_text
from vla.reports.comparison import compare_rows, differences_table, remarks
from vla.reports.comparison_page import SWEEP, results_table, success_panels, write_comparison
from vla.reports.pictures import save
from vla.runs.sweep import SweepRow, failures, read_rows


def tabulate(folder: Path) -> list[SweepRow]:
    """Write the table of a sweep's folder and return its rows; without any report, write nothing."""
    rows = read_rows(folder)
    if rows:
        compared = compare_rows(rows, at(rows[0].runs[0].config, "evaluate.margin", 0.0))
        failed = failures(folder)
        with atomic_path(folder / "sweep.csv") as draft:
            _write_csv(rows, draft)
        tables = [results_table(rows), *([differences_table(compared)] if compared else [])]
        texts = [*(table.markdown() for table in tables), "".join(f"- failed: {line}\n" for line in failed)]
        write_text(folder / "sweep.md", "\n".join(filter(None, texts)))
        size = 4, max(2.5, 0.5 + 0.25 * len(rows))
        save(folder / "sweep.png", success_panels(rows), 4, size, "success, 95 % CI")
        with warn_on_error(folder / SWEEP):
            facts = {f"failed cell {number}": line for number, line in enumerate(failed, 1)}
            facts |= remarks({run.folder.name: run for row in rows for run in row.runs})
            write_comparison(folder / SWEEP, f"Sweep {folder.resolve().name}", rows, compared, facts)
    return rows


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
