"""Results of a sweep: cells that differ only in the training seed form one row."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from vla.rollouts.results import ERROR
from vla.rollouts.statistics import pooled_interval
from vla.runs.cells import FAILURE, cells, overrides_of, varied_keys
from vla.runs.folder import REPORT, Run, read_run
from vla.spec import IN_DISTRIBUTION

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
    def parameters(self) -> int:
        """Number of parameters; 0 if another agent than a policy acted."""
        return self.runs[0].parameters or 0

    @property
    def latencies(self) -> list[float]:
        """Latencies of the cells in which a policy acted [ms]."""
        return [run.report.latency_ms for run in self.runs if run.report and run.report.latency_ms]

    @property
    def rates(self) -> list[float]:
        """Success rate of every cell."""
        return [run.reports[IN_DISTRIBUTION].success for run in self.runs]

    @cached_property
    def played(self) -> dict[str, list[dict[int, bool]]]:
        """Condition → for every cell, seed → success; without errors."""
        found: dict[str, list[dict[int, bool]]] = {}
        for condition, report in (each for run in self.runs for each in run.reports.items()):
            ended = {result.seed: result.success for result in report.results if result.outcome != ERROR}
            found.setdefault(condition, []).append(ended)
        return found

    @property
    def latency(self) -> float:
        """Minimum latency of the cells [ms], because other load on the machine only increases it; needs a policy."""
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
        """Return the success rate and its 95 % confidence interval, of several cells over trainings and scenes."""
        if len(self.runs) == 1:  # its own: stratified with tiers, anytime-valid where playing stopped early
            report = self.runs[0].reports[condition]
            return (report.success, *report.interval)
        rate = self.successes[condition] / max(self.episodes[condition], 1)
        return (rate, *pooled_interval(self.played[condition]))


def conditions_of(rows: list[SweepRow]) -> list[str]:
    """Return the conditions of all rows, in the order in which they appear."""
    return list(dict.fromkeys(condition for row in rows for condition in row.played))


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
        rows.setdefault(tuple(choices.values()), SweepRow(choices)).runs.append(run)
    return list(rows.values())
