"""`job=report`: compare runs on one page."""

from __future__ import annotations

import logging
from itertools import combinations
from pathlib import Path

from vla.config.experiment import Experiment
from vla.config.nodes import ReportedRuns
from vla.io.printable import show
from vla.reports.comparison import compare, difference_tables, read_runs, remarks, rows_of
from vla.reports.comparison_page import COMPARISON, write_comparison

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Write `comparison.html`, and print how the runs differ."""
    runs = read_runs([Path(folder) for folder in experiment.options(ReportedRuns).runs])
    compared = compare(combinations(rows_of(runs), 2), experiment.evaluate.margin)
    for table in difference_tables(compared):
        if table.rows:
            show(table)
    for remark, names in (notes := remarks(runs, compared)).items():
        log.info("%s: %s", remark, names)
    title = f"{len(runs)} runs" if len(runs) > 1 else next(iter(runs))
    page = Path(experiment.settings.output) / COMPARISON
    log.info("wrote %s", write_comparison(page, title, rows_of(runs), compared, notes))
