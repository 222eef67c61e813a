"""Files of a run's folder: config, training, metrics and report."""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from vla.config.differences import value_at
from vla.io.documents import read_json, read_yaml
from vla.io.errors import UserError
from vla.io.files import require_file, write_text
from vla.rollouts.results import Report
from vla.runs.files import Change, ErrorsFile, Node, ReportFile, Training
from vla.spec import IN_DISTRIBUTION, Array

log = logging.getLogger(__name__)

T = TypeVar("T")
Curve = tuple[Array, Array]  # steps (N,) and values (N,)

CONFIG, CHANGES, TRAINING = "config.yaml", "changes.yaml", "training.json"
METRICS, REPORT, EPISODES = "metrics.csv", "report.json", "episodes"  # the last: store of a round of job=improve
PAGE, RECORDING = "report.html", "rollouts.rrd"
RECORDINGS = "recordings"  # folder of moving pictures, and of single recordings until, or unless, they are merged
SAMPLES, PLOT, SUITE = "samples.png", "report.png", "suite.png"
ERRORS, ERRORS_PLOT = "errors.json", "errors.png"  # of an open-loop evaluation, in place of a report
LARGEST_METRIC, MOST_METRICS = 1e100, 300  # limits for curves: value, and number; a training has about 20
LARGEST_METRICS = 64 << 20  # [bytes] of metrics.csv that are read, about 250 000 rows
LARGEST_REPORT = 4 << 30  # [bytes], a million episodes
CHECKPOINTS, LAST = "checkpoints", "last.ckpt"  # folder of a training's checkpoints, and the newest one


@dataclass(frozen=True)
class Run:
    """Contents of a run's folder; missing files are empty or None."""

    folder: Path
    config: Node  # resolved
    changes: list[Change] | None
    training: Training | None
    metrics: dict[str, Curve]
    report: ReportFile | None
    errors: ErrorsFile | None

    @property
    def policy(self) -> str:
        """Name of the model's class, or of another agent's option; an empty string if unknown."""
        if value_at(self.config, "agent", None):
            return str(value_at(self.config, "chosen.agent", "")).replace("_", " ")
        return str(value_at(self.config, "model._target_", "")).rpartition(".")[2]

    @property
    def tasks(self) -> list[str]:
        """Names of the evaluated tasks."""
        return [*self.reports[IN_DISTRIBUTION].tasks] if self.report else []

    @property
    def parameters(self) -> int | None:
        """Number of the model's parameters, if known."""
        source = self.training or self.report or self.errors
        return source.parameters if source else None

    @property
    def reports(self) -> dict[str, Report]:
        """Condition → report, the training condition first; empty without an evaluation."""
        return self.report.reports if self.report else {}


def read_run(folder: Path) -> Run:
    """Read a run's folder; every file is optional, and a UserError names one that is damaged."""
    report, errors = read_report(folder), _read(folder / ERRORS, partial(read_json, kind=ErrorsFile), None)
    evaluation = report or errors
    config = _read(folder / CONFIG, partial(read_yaml, kind=Node), evaluation.config if evaluation else {})
    changes = _read(folder / CHANGES, partial(read_yaml, kind=list[Change]), None)
    metrics: dict[str, Curve] = _read(folder / METRICS, _curves, {})
    return Run(folder, config, changes, read_training(folder), metrics, report, errors)


def read_report(folder: Path) -> ReportFile | None:
    """Read the report of a run's folder, or return None; raise a UserError if the file is damaged."""
    return _read(folder / REPORT, partial(read_json, kind=ReportFile, max_bytes=LARGEST_REPORT), None)


def read_training(folder: Path) -> Training | None:
    """Read the result of a run's training, or return None; raise a UserError if the file is damaged."""
    return _read(folder / TRAINING, partial(read_json, kind=Training), None)


def archive_evaluation(folder: Path, number: int) -> None:
    """Append `number`, of steps or rounds, to the names of an evaluation's files: more training changes the policy."""
    for file in (folder / name for name in (REPORT, PLOT, SUITE, ERRORS, ERRORS_PLOT, RECORDING)):
        if file.exists():
            file.replace(folder / f"{file.stem}_{number}{file.suffix}")


def require_run(folder: Path) -> Run:
    """Read a run's folder; raise a UserError if it has neither a report, nor open-loop errors, nor metrics."""
    if not any((folder / name).is_file() for name in (REPORT, ERRORS, METRICS)):
        raise UserError(f"{folder} is no run: it has none of {REPORT}, {ERRORS} and {METRICS}")
    return read_run(folder)


def save_config(folder: Path, config: Mapping[str, Any], changes: list[Node]) -> None:
    """Save the resolved config and its differences from the default."""
    for name, content in ((CONFIG, config), (CHANGES, changes)):
        write_text(folder / name, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120))


def describe_files(files: Sequence[Path | None]) -> str:
    """List the files of a folder that exist, the first one with its path."""
    first, *others = [file for file in files if file and file.is_file()]
    return ", ".join([str(first), *(file.name for file in others)])


def save_training(folder: Path, training: Training) -> None:
    """Save the result of a training."""
    write_text(folder / TRAINING, json.dumps(asdict(training), ensure_ascii=False) + "\n")


def _read(path: Path, read: Callable[[Path], T], default: T) -> T:
    if not path.is_file():
        return default
    try:
        return read(path)
    except ValueError as error:
        raise UserError(f"{error}; remove the file, or repeat the run") from error


def _curves(path: Path) -> dict[str, Curve]:
    """Read the columns of metrics.csv; a step logged again after an interruption has its later value."""
    points: dict[str, dict[int, float]] = {}
    for row in metric_rows(path):
        for name, value in row.items():
            if name not in ("step", "epoch") and abs(float(value)) < LARGEST_METRIC:
                points.setdefault(name, {})[int(row["step"])] = float(value)
    return {name: (np.array(sorted(at)), np.array([at[step] for step in sorted(at)])) for name, at in points.items()}


def metric_rows(path: Path) -> list[dict[str, str]]:
    """Read the rows of metrics.csv, column → number as text, without empty cells; each has a `step`.

    Of a file larger than `LARGEST_METRICS` only the last rows are read. Raises a UserError if it has no steps, or holds
    anything but numbers.
    """
    require_file(path)
    with path.open("rb") as file:
        head = file.readline(LARGEST_METRICS)
        if (offset := path.stat().st_size - LARGEST_METRICS) > len(head):
            log.warning("of %s, which has %d bytes, only the last rows are read", path, path.stat().st_size)
            file.seek(offset)
            file.readline(LARGEST_METRICS)  # the rest of a row
        text = (head + file.read(LARGEST_METRICS)).decode("utf-8", "replace")
    rows, records = csv.reader(io.StringIO(text, newline="")), []
    try:
        names = next(rows, ["step"])
        if "step" not in names or len(set(names)) < len(names) or len(names) > MOST_METRICS:
            raise UserError(f"it has no column step, two of one name, or more than {MOST_METRICS} columns")
        for row in rows:
            if len(row) >= len(names):  # else truncated by a killed process
                numbers = {name: value for name, value in zip(names, row, strict=True) if value}
                if not 0 <= int(numbers.get("step", -1)) < 2**31 or not [*map(float, numbers.values())]:
                    raise UserError(f"step must be a number from 0 to {2**31 - 1}, got {numbers.get('step')}")
                records.append(numbers)
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path} is damaged in line {rows.line_num}: {str(error)[:200]}") from error
    return records
