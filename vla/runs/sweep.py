"""A sweep's folder on disk: its cells, why they failed, and results, in rows of cells that differ only in their seed.

A cell is the run folder of one job of the sweep.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from vla.io.documents import read_bounded, read_yaml
from vla.io.files import write_text
from vla.rollouts.results import ERROR
from vla.rollouts.statistics import pooled_interval
from vla.runs.folder import ERRORS, REPORT, Run, read_run
from vla.spec import IN_DISTRIBUTION

OVERRIDES = ".hydra/overrides.yaml"  # written by Hydra in the folder of every cell
FAILURE = "error.txt"  # in the folder of a failed cell
DEMONSTRATIONS = "collect.episodes"  # override that is the x axis of learning curves
SEED = "seed"  # override that distinguishes the cells of one row


@dataclass
class SweepRow:
    """Cells that differ only in their training seed."""

    choices: dict[str, str]  # overrides that distinguish the row
    runs: list[Run] = field(default_factory=list)  # its cells, evaluated

    @property
    def name(self) -> str:
        """Label in tables and plots."""
        return " ".join(self.choices.values()) or "all"

    @property
    def rates(self) -> list[float]:
        """Success rate of every cell that has one."""
        return [run.reports[IN_DISTRIBUTION].success for run in self.runs if run.reports]

    @property
    def relative_error(self) -> float | None:
        """Mean error on recordings, as a fraction of that of a constant action; None without any."""
        errors = [run.errors.relative for run in self.runs if run.errors]
        return sum(errors) / len(errors) if errors else None

    @cached_property
    def successes(self) -> dict[str, list[dict[int, bool]]]:
        """Condition → for every cell, seed → success; without errors."""
        outcomes: dict[str, list[dict[int, bool]]] = {}
        for condition, report in (item for run in self.runs for item in run.reports.items()):
            successes = {result.seed: result.success for result in report.results if result.outcome != ERROR}
            outcomes.setdefault(condition, []).append(successes)
        return outcomes

    @property
    def episodes(self) -> dict[str, int]:
        """Condition → number of episodes over all cells."""
        return {condition: sum(map(len, cells)) for condition, cells in self.successes.items()}

    def interval(self, condition: str) -> tuple[float, float, float]:
        """Return the success rate and its 95 % confidence interval; of several cells, over trainings and scenes."""
        if len(self.runs) == 1:  # the interval of its report: stratified with tiers, anytime-valid after early stopping
            report = self.runs[0].reports[condition]
            return (report.success, *report.interval)
        successes = sum(sum(cell.values()) for cell in self.successes[condition])
        rate = successes / max(self.episodes[condition], 1)
        return (rate, *pooled_interval(self.successes[condition]))


def conditions_of(rows: list[SweepRow]) -> list[str]:
    """Return the conditions of all rows, in the order in which they appear."""
    return list(dict.fromkeys(condition for row in rows for condition in row.successes))


def read_rows(folder: Path) -> list[SweepRow]:
    """Read the rows of all cells that were evaluated and did not fail, in the order of the sweep."""
    evaluations = [
        (overrides_of(cell), read_run(cell))
        for cell in cells(folder, OVERRIDES)  # other folders with a report are no cells
        if any((cell / name).exists() for name in (REPORT, ERRORS))
        and not (cell / FAILURE).exists()  # the report may be of other overrides
    ]
    keys = [key for key in varied_keys([overrides for overrides, _ in evaluations]) if key != SEED]
    rows: dict[tuple[str, ...], SweepRow] = {}
    for overrides, run in evaluations:
        choices = {key: overrides.get(key, "default") for key in keys}
        rows.setdefault(tuple(choices.values()), SweepRow(choices)).runs.append(run)
    return list(rows.values())


def save_failure(cell: Path, reason: str) -> None:
    """Save why a cell failed; the list of failures quotes the first line."""
    write_text(cell / FAILURE, f"{reason}\n")


def describe_failures(folder: Path) -> str:
    """Return the number of failed cells of a sweep, and a line for each."""
    lines, count = failures(folder), len({*cells(folder, OVERRIDES), *cells(folder, FAILURE)})
    return "\n  ".join([f"{len(lines)} of {count} cells failed, see {FAILURE} of each in {folder}", *lines])


def failures(folder: Path) -> list[str]:
    """Describe the failed cells of a sweep: name, choices and reason of each."""
    choices_of = {cell: overrides_of(cell) for cell in cells(folder, OVERRIDES)}
    keys = varied_keys(list(choices_of.values()))
    lines = []
    for cell in cells(folder, FAILURE):
        choices = "".join(f" {key}={choices_of[cell][key]}" for key in keys if key in choices_of.get(cell, ()))
        reason = read_bounded(cell / FAILURE).decode("utf-8", "replace").partition("\n")[0]
        lines.append(f"{cell.name}{choices}: {reason}")
    return lines


def cells(folder: Path, having: str) -> list[Path]:
    """Return the cells that contain the file `having`, in the order of the sweep."""
    folders = [cell for cell in folder.iterdir() if (cell / having).exists()]
    return sorted(folders, key=lambda cell: (len(cell.name), cell.name))


def overrides_of(cell: Path) -> dict[str, str]:
    """Return key → value of a cell's command line."""
    pairs = (override.partition("=") for override in read_yaml(cell / OVERRIDES, list[str]))
    return {key.lstrip("+~"): value for key, _, value in pairs}


def varied_keys(choices: list[dict[str, str]]) -> list[str]:
    """Return the overrides that differ between cells."""
    keys = dict.fromkeys(key for overrides in choices for key in overrides)
    return [key for key in keys if len({overrides.get(key) for overrides in choices}) > 1]
