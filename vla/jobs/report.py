"""`job=report`: compare runs on one page."""

from __future__ import annotations

import logging
from pathlib import Path

from vla.config.experiment import Experiment
from vla.config.nodes import ReportedRuns
from vla.io.printable import show
from vla.reports.comparison import CASE, compare_runs, read_runs, remarks, runs_table, secondary_rows
from vla.reports.comparison_page import write_comparison
from vla.reports.conditions import secondary_table

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Write `comparison.html`, and print how the runs differ."""
    runs = read_runs([Path(folder) for folder in experiment.options(ReportedRuns).runs])
    compared = compare_runs(runs, experiment.evaluate.margin)
    if compared:
        show(runs_table(compared))
    for remark in remarks(runs, compared):
        log.info("%s", remark)
    if rows := secondary_rows(compared):
        show(secondary_table(rows, CASE))
    log.info("wrote %s", write_comparison(runs, compared, Path(experiment.settings.output)))
