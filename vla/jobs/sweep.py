"""The Hydra callback that tabulates a sweep."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from vla.io.printable import show

if TYPE_CHECKING:
    from vla.runs.sweep import SweepRow

LOCK = ".lock"  # in the folder of a sweep
TABLE_INTERVAL = 10  # up to so many ended cells each one updates the table, then every tenth: it reads all cells


class SweepTable(Callback):
    """Writes `sweep.html`, `sweep.md` and `sweep.png` after the first cells, every `TABLE_INTERVAL`, and at the end."""

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remove an earlier error of the cell."""
        if config.hydra.mode == RunMode.MULTIRUN:
            from vla.runs.sweep import FAILURE  # imports libraries, as below

            (Path(config.hydra.runtime.output_dir) / FAILURE).unlink(missing_ok=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write the table of all cells that have a report."""
        if config.hydra.mode == RunMode.MULTIRUN:
            from vla.runs.folder import REPORT
            from vla.runs.sweep import FAILURE, cells

            if job_return.status == JobStatus.COMPLETED:  # from a concurrent sweep in this folder
                (Path(config.hydra.runtime.output_dir) / FAILURE).unlink(missing_ok=True)
            folder = Path(config.hydra.sweep.dir)
            count = len({*cells(folder, REPORT), *cells(folder, FAILURE)})
            if count <= TABLE_INTERVAL or count % TABLE_INTERVAL == 0:
                write_table(folder)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the table of the sweep, and name its page; end the process with an error if there are no cells.

        If a cell failed, Hydra does not call this, and `vla.run` writes the table.
        """
        from vla.reports.comparison_page import SWEEP, results_table  # imports matplotlib
        from vla.runs.sweep import OVERRIDES, cells

        folder = Path(config.hydra.sweep.dir)
        if not (folder.is_dir() and cells(folder, OVERRIDES)):
            print("error: the sweep has no cells: one of its ranges or choices is empty", file=sys.stderr)
            sys.exit(1)
        if rows := write_table(folder):
            show(results_table(rows))
        if (page := folder / SWEEP).exists():
            print(f"wrote {page}")


def write_table(folder: Path) -> list[SweepRow]:
    """Write the table of all cells of a sweep that have ended, and return its rows."""
    from vla.reports.comparison_page import tabulate  # imports matplotlib

    with FileLock(folder / LOCK):  # the last holder of the lock writes all cells
        return tabulate(folder)
