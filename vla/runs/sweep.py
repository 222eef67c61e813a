"""A sweep's folder on disk: its cells, failures and results.

A cell is the run folder of one job of the sweep; cells that differ only in the training seed form one row.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from vla.io.documents import read_bounded, read_yaml
from vla.io.files import write_text
from vla.rollouts.evaluate import ERROR
from vla.rollouts.statistics import pooled_interval
from vla.runs.folder import REPORT, read_run

DEMONSTRATIONS = "collect.episodes"  # override that is the x axis of learning curves
SEED = "seed"  # override that distinguishes the cells of one row
OVERRIDES = ".hydra/overrides.yaml"  # written by Hydra in the folder of every cell
FAILURE = "error.txt"  # in the folder of a failed cell


@dataclass
class SweepRow:
    """Cells that differ only in their training seed."""

    choices: dict[str, str]  # overrides that distinguish the row
    parameters: int
    cells: list[Path] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)  # per cell [ms]
    rates: list[float] = field(default_factory=list)  # success rate per cell
    played: dict[str, list[dict[int, bool]]] = field(default_factory=dict)  # condition → per cell, seed → success

    @property
    def name(self) -> str:
        """Label in tables and plots."""
        return " ".join(self.choices.values()) or "all"

    @property
    def latency(self) -> float:
        """Minimum latency of the cells [ms], because other load on the machine only increases it."""
        return min(self.latencies)

    @property
    def successes(self) -> dict[str, int]:
        """Condition → number of successes over all cells."""
        return {condition: sum(sum(cell.values()) for cell in cells) for condition, cells in self.played.items()}

    @property
    def episodes(self) -> dict[str, int]:
        """Condition → number of episodes over all cells."""
        return {condition: sum(map(len, cells)) for condition, cells in self.played.items()}

    def interval(self, condition: str) -> tuple[float, float, float]:
        """Return the pooled success rate and its 95 % confidence interval over trainings and scenes."""
        rate = self.successes[condition] / max(self.episodes[condition], 1)
        return (rate, *pooled_interval(self.played[condition]))


def save_failure(cell: Path, reason: str) -> None:
    """Save why a cell failed; the list of failures quotes the first line."""
    write_text(cell / FAILURE, f"{reason}\n")


def failures(folder: Path) -> str:
    """Describe the failed cells of a sweep: their number, then choices and reason of each."""
    choices_of = {cell: overrides_of(cell) for cell in cells(folder, OVERRIDES)}
    varied = varied_keys(list(choices_of.values()))
    lines = []
    for cell in cells(folder, FAILURE):
        choices = "".join(f" {key}={choices_of[cell][key]}" for key in varied if key in choices_of[cell])
        reason = read_bounded(cell / FAILURE).decode("utf-8", "replace").partition("\n")[0]
        lines.append(f"\n  {cell.name}{choices}: {reason}")
    return f"{len(lines)} of {len(choices_of)} cells failed, see {FAILURE} of each in {folder}{''.join(lines)}"


def read_rows(folder: Path) -> list[SweepRow]:
    """Read the rows of all cells that have a report and did not fail, in the order of the sweep."""
    reported = [
        (overrides_of(cell), read_run(cell))
        for cell in cells(folder, REPORT)
        if not (cell / FAILURE).exists()  # its report may be of other overrides
    ]
    varied = [key for key in varied_keys([overrides for overrides, _ in reported]) if key != SEED]
    rows: dict[tuple[str, ...], SweepRow] = {}
    for overrides, run in reported:
        choices = {key: overrides.get(key, "default") for key in varied}
        file = run.report
        if file is None or file.parameters is None or file.latency_ms is None:
            raise ValueError(f"{run.folder / REPORT} is of no evaluation: it lacks parameters or latency_ms")
        row = rows.setdefault(tuple(choices.values()), SweepRow(choices, file.parameters))
        row.cells.append(run.folder)
        row.latencies.append(file.latency_ms)
        row.rates.append(file.success)
        for condition, report in run.reports.items():
            ended = {result.seed: result.outcome == "success" for result in report.results if result.outcome != ERROR}
            row.played.setdefault(condition, []).append(ended)
    return list(rows.values())


def cells(folder: Path, having: str) -> list[Path]:
    """Return the cells that contain the file `having`, in the order of the sweep."""
    found = [cell for cell in folder.iterdir() if (cell / having).exists()]
    return sorted(found, key=lambda cell: (len(cell.name), cell.name))


def overrides_of(cell: Path) -> dict[str, str]:
    """Return key → value of a cell's command line."""
    pairs = (override.partition("=") for override in read_yaml(cell / OVERRIDES, list[str]))
    return {key.lstrip("+~"): value for key, _, value in pairs}


def varied_keys(choices: list[dict[str, str]]) -> list[str]:
    """Return the overrides that differ between cells."""
    keys = dict.fromkeys(key for overrides in choices for key in overrides)
    return [key for key in keys if len({overrides.get(key) for overrides in choices}) > 1]
