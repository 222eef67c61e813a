"""What a sweep found, as one table that grows with every cell: CSV, Markdown, a picture, and a page with all of it.

A cell is a folder of the sweep; cells that differ in nothing but the seed of training make one row.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from filelock import FileLock
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from vla.files import atomic_path, write_text

DEMONSTRATIONS = "collect.episodes"  # the override over which success is drawn
SEED = "seed"  # the override that distinguishes the cells of one row
OVERRIDES = ".hydra/overrides.yaml"  # what Hydra leaves in the folder of every cell
FAILURE = "error.txt"  # in the folder of a cell that failed


@dataclass
class Row:
    """Cells that differ in their seeds alone."""

    choices: dict[str, str]  # the overrides that distinguish it from the other rows
    parameters: int
    cells: list[Path] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)  # [ms], of each cell
    rates: list[float] = field(default_factory=list)  # success, of each cell
    played: dict[str, list[dict[int, bool]]] = field(default_factory=dict)  # condition → of each cell, seed → success

    @property
    def name(self) -> str:
        """What stands in the table, and beside the point in the picture."""
        return " ".join(self.choices.values()) or "all"

    @property
    def latency(self) -> float:
        """The least of the cells [ms]: whatever else the machine was busy with only added."""
        return min(self.latencies)

    @property
    def successes(self) -> dict[str, int]:
        """Condition → how many episodes succeeded, of all cells."""
        return {condition: sum(sum(cell.values()) for cell in cells) for condition, cells in self.played.items()}

    @property
    def episodes(self) -> dict[str, int]:
        """Condition → how many episodes were played, of all cells."""
        return {condition: sum(map(len, cells)) for condition, cells in self.played.items()}

    def interval(self, condition: str) -> tuple[float, float, float]:
        """Success rate of all cells together and its 95 % confidence interval, for other trainings on other scenes."""
        from vla.intervals import pooled_interval

        rate = self.successes[condition] / max(self.episodes[condition], 1)
        return (rate, *pooled_interval(self.played[condition]))


class Tabulate(Callback):
    """Writes `sweep.html` and what it shows, `sweep.csv`, `sweep.md` and `sweep.png`, anew after every cell."""

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Forget how the cell failed before."""
        (Path(config.hydra.runtime.output_dir) / FAILURE).unlink(missing_ok=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write the table of all cells that have a report by now."""
        if config.hydra.mode == RunMode.MULTIRUN:
            if job_return.status == JobStatus.COMPLETED:  # another sweep in this folder may have failed at it meanwhile
                (Path(config.hydra.runtime.output_dir) / FAILURE).unlink(missing_ok=True)
            folder = Path(config.hydra.sweep.dir)
            with FileLock(folder / ".lock"):  # the last cell to get it sees all others
                tabulate(folder)


def note_failure(cell: Path, reason: str) -> None:
    """Leave in the folder of a cell why it failed; the first line is for the list of all that did."""
    (cell / FAILURE).write_text(f"{reason}\n", encoding="utf-8")


def failures(folder: Path) -> str:
    """What there is to say of the cells of a sweep that failed: how many, then each with its choices and its reason."""
    cells = {cell: _overrides(cell) for cell in _cells(folder, OVERRIDES)}
    telling = _telling(list(cells.values()))
    lines = []
    for cell in _cells(folder, FAILURE):
        choices = "".join(f" {key}={cells[cell][key]}" for key in telling if key in cells[cell])
        reason = (cell / FAILURE).read_text(encoding="utf-8").partition("\n")[0]
        lines.append(f"\n  {cell.name}{choices}: {reason}")
    return f"{len(lines)} of {len(cells)} cells failed, see {FAILURE} of each in {folder}{''.join(lines)}"


def tabulate(folder: Path) -> list[Row]:
    """Write the table of a sweep's folder, and return its rows; nothing is written where no cell has a report yet."""
    rows = read_rows(folder)
    if rows:
        from vla.sweep_plot import plot

        with atomic_path(folder / "sweep.csv") as draft:
            _write_csv(rows, draft)
        write_text(folder / "sweep.md", markdown(rows))
        with atomic_path(folder / "sweep.png") as draft:
            plot(rows, draft)
        _write_page(rows, folder)
    return rows


def read_rows(folder: Path) -> list[Row]:
    """The cells that have a report, and did not fail since, put together, in the order of the sweep."""
    from vla.evaluate import ERROR
    from vla.results import REPORT, read_run

    cells = [
        (_overrides(cell), read_run(cell))
        for cell in _cells(folder, REPORT)
        if not (cell / FAILURE).exists()  # its report may be of other overrides
    ]
    telling = [key for key in _telling([overrides for overrides, _ in cells]) if key != SEED]
    rows: dict[tuple[str, ...], Row] = {}
    for overrides, run in cells:
        choices = {key: overrides.get(key, "default") for key in telling}
        file = run.report
        if file is None or file.parameters is None or file.latency_ms is None:
            raise ValueError(f"{run.folder / REPORT} is of no evaluation: it lacks parameters or latency_ms")
        row = rows.setdefault(tuple(choices.values()), Row(choices, file.parameters))
        row.cells.append(run.folder)
        row.latencies.append(file.latency_ms)
        row.rates.append(file.success)
        for condition, report in run.reports.items():
            ended = {result.seed: result.outcome == "success" for result in report.results if result.outcome != ERROR}
            row.played.setdefault(condition, []).append(ended)
    return list(rows.values())


def _cells(folder: Path, having: str) -> list[Path]:
    """The cells that have a file, in the order of the sweep."""
    cells = [cell for cell in folder.iterdir() if (cell / having).exists()]
    return sorted(cells, key=lambda cell: (len(cell.name), cell.name))


def _overrides(cell: Path) -> dict[str, str]:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    from vla.documents import read_yaml

    said = OverridesParser.create().parse_overrides(read_yaml(cell / OVERRIDES, list[str]))
    return {one.key_or_group: one.get_value_element_as_str() for one in said}


def _telling(cells: list[dict[str, str]]) -> list[str]:
    """The overrides that are not the same in all cells."""
    keys = dict.fromkeys(key for overrides in cells for key in overrides)
    return [key for key in keys if len({overrides.get(key) for overrides in cells}) > 1]


def markdown(rows: list[Row]) -> str:
    """The table for people: success under every condition with its interval, then what each row costs."""
    conditions = list(dict.fromkeys(condition for row in rows for condition in row.played))
    head = [*rows[0].choices, *(f"{name} [%]" for name in conditions), "each seed [%]", "parameters [M]", "action [ms]"]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        shares = []
        for condition in conditions:
            if condition not in row.played:
                shares.append("-")
                continue
            rate, low, high = (100 * value for value in row.interval(condition))
            shares.append(f"{rate:.1f} ({low:.1f}-{high:.1f})")
        seeds = ", ".join(f"{100 * rate:.1f}" for rate in row.rates)
        lines.append([*row.choices.values(), *shares, seeds, f"{row.parameters / 1e6:.2f}", f"{row.latency:.1f}"])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _write_page(rows: list[Row], folder: Path) -> None:
    """What the other files say, with the curves of the cells and the way to their pages."""
    from vla.page import SWEEP, Line, optional, write_sweep

    lines = [
        Line(
            list(row.choices.values()),
            {condition: row.interval(condition) for condition in row.played},
            [", ".join(f"{100 * rate:.1f}" for rate in row.rates), f"{row.parameters / 1e6:.2f}", f"{row.latency:.1f}"],
            {cell.name: f"{quote(cell.name)}/report.html" for cell in row.cells},
        )
        for row in rows
    ]
    with optional(folder / SWEEP):
        write_sweep(folder, list(rows[0].choices), lines, [cell for row in rows for cell in row.cells])


def _write_csv(rows: list[Row], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        columns = ["condition", "success", "ci_low", "ci_high", "successes", "episodes", "cells"]
        writer.writerow([*rows[0].choices, *columns, "parameters", "latency_ms"])
        for row in rows:
            for condition in row.played:
                counts = [row.successes[condition], row.episodes[condition], len(row.rates)]
                costs = [row.parameters, round(row.latency, 3)]
                writer.writerow([*row.choices.values(), condition, *row.interval(condition), *counts, *costs])
