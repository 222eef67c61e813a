"""The table of a sweep, updated after every cell: Markdown, PNG and HTML."""

from __future__ import annotations

from pathlib import Path

from vla.config.differences import at
from vla.io.files import warn_on_error, write_text
from vla.reports.comparison import compare, difference_tables, remarks
from vla.reports.comparison_page import SWEEP, results_table, success_panels, write_comparison
from vla.reports.pictures import save
from vla.runs.sweep import SweepRow, failures, read_rows


def tabulate(folder: Path) -> list[SweepRow]:
    """Write the table of a sweep's folder and return its rows; without any report, write nothing."""
    rows = read_rows(folder)
    if rows:
        margin = at(rows[0].runs[0].config, "evaluate.margin", 0.0)
        compared = compare(((rows[0], other) for other in rows[1:]), margin)
        failed = failures(folder)
        tables = [results_table(rows), *(difference_tables(compared)[:1] if compared else [])]
        texts = [*(table.markdown() for table in tables), "".join(f"- failed: {line}\n" for line in failed)]
        write_text(folder / "sweep.md", "\n".join(filter(None, texts)))
        size = 4, max(2.5, 0.5 + 0.25 * len(rows))
        save(folder / "sweep.png", success_panels(rows), 4, size, "success, 95 % CI")
        with warn_on_error(folder / SWEEP):
            facts = {f"failed cell {number}": line for number, line in enumerate(failed, 1)}
            facts |= remarks({run.folder.name: run for row in rows for run in row.runs})
            write_comparison(folder / SWEEP, f"Sweep {folder.resolve().name}", rows, compared, facts)
    return rows
