"""Files of a run's folder: config, training, metrics and report."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from vla.config.differences import at
from vla.io.documents import read_bounded, read_json, read_yaml
from vla.io.files import write_text
from vla.rollouts.evaluate import IN_DISTRIBUTION, Report, Result
from vla.runs.files import Change, Node, ReportFile, Training
from vla.spec import Array

T = TypeVar("T")
Curve = tuple[Array, Array]  # steps (N,) and values (N,)

CONFIG, CHANGES, TRAINING = "config.yaml", "changes.yaml", "training.json"
METRICS, REPORT = "metrics.csv", "report.json"
CHECKPOINTS, LAST = "checkpoints", "last.ckpt"  # the folder of weights, and those of the newest save


@dataclass(frozen=True)
class Run:
    """Contents of a run's folder; missing files are empty or None."""

    folder: Path
    config: Node  # resolved
    changes: list[Change] | None
    training: Training | None
    metrics: dict[str, Curve]
    report: ReportFile | None

    @property
    def model(self) -> str:
        """Name of the model's class, or an empty string."""
        return str(at(self.config, "model._target_", "")).rpartition(".")[2]

    @property
    def tasks(self) -> list[str]:
        """Names of the evaluated tasks."""
        return [*self.reports[IN_DISTRIBUTION].tasks] if self.report else []

    @property
    def parameters(self) -> int | None:
        """Number of the model's parameters, if known."""
        known = self.training or self.report
        return known.parameters if known else None

    @property
    def chosen(self) -> str | None:
        """File name of the checkpoint selected for evaluation, or None if none is selected yet."""
        return self.training.checkpoint if self.training else None

    def wall_time(self, evaluation: float) -> float | None:
        """Return the wall time of collection, training and the given evaluation [s], or None if unknown."""
        if self.training is None or self.training.collection_s is None:
            return None
        return round(self.training.collection_s + self.training.seconds + evaluation, 1)

    @cached_property
    def reports(self) -> dict[str, Report]:
        """Condition → report, the training condition first; reports of the others have only seeds and outcomes."""
        if not self.report:
            return {}
        others = {
            name: Report(tuple(map(Result, self.report.seeds, part.outcomes)))
            for name, part in self.report.conditions.items()
        }
        tiers = {tier: [*part.tasks] for tier, part in self.report.tiers.items()}
        return {IN_DISTRIBUTION: Report(tuple(self.report.per_episode), tiers), **others}


def read_run(folder: Path) -> Run:
    """Read a run's folder; every file is optional.

    Raises:
        ValueError: a file is damaged.
    """
    report = _read(folder / REPORT, partial(read_json, kind=ReportFile), None)
    config = _read(folder / CONFIG, partial(read_yaml, kind=Node), report.config if report else {})
    changes = _read(folder / CHANGES, partial(read_yaml, kind=list[Change]), None)
    training = _read(folder / TRAINING, partial(read_json, kind=Training), None)
    metrics: dict[str, Curve] = _read(folder / METRICS, _curves, {})
    return Run(folder, config, changes, training, metrics, report)


def run_of(checkpoint: str | Path) -> Run:
    """Read the run that wrote a checkpoint.

    Raises:
        ValueError: a file is damaged.
    """
    return read_run(Path(checkpoint).resolve().parent.parent)


def require_run(folder: Path) -> Run:
    """Read a run's folder that has at least a report or metrics.

    Raises:
        ValueError: the folder has neither, or a file is damaged.
    """
    if not any((folder / name).is_file() for name in (REPORT, METRICS)):
        raise ValueError(f"{folder} is no run: it has neither {REPORT} nor {METRICS}")
    return read_run(folder)


def save_config(folder: Path, config: Mapping[str, Any], changes: list[Node]) -> None:
    """Save the resolved config and its differences from the default."""
    for name, content in ((CONFIG, config), (CHANGES, changes)):
        write_text(folder / name, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120))


def save_training(
    folder: Path, parameters: int, steps: int, seconds: float, ended: str, collection: float | None = None
) -> None:
    """Save the result of a training.

    Args:
        folder: of the run.
        parameters: of the model.
        steps: of the optimiser.
        seconds: duration of training [s].
        ended: "done", "interrupted", or an error.
        collection: duration of the collection [s], if known.
    """
    collected = None if collection is None else round(collection, 1)
    _write_training(folder, Training(parameters, steps, round(seconds, 1), ended, collected))


def save_choice(folder: Path, checkpoint: str) -> None:
    """Add the checkpoint selected for evaluation to what `save_training` wrote."""
    _write_training(folder, replace(read_json(folder / TRAINING, Training), checkpoint=checkpoint))


def _write_training(folder: Path, training: Training) -> None:
    write_text(folder / TRAINING, json.dumps(asdict(training), ensure_ascii=False) + "\n")


def _read(path: Path, read: Callable[[Path], T], otherwise: T) -> T:
    if not path.is_file():
        return otherwise
    try:
        return read(path)
    except ValueError as error:
        raise ValueError(f"{error}; remove the file, or repeat the run") from error


def _curves(path: Path) -> dict[str, Curve]:
    """Read the columns of metrics.csv; a step logged again after an interruption has its later value."""
    points: dict[str, dict[int, float]] = {}
    rows = csv.reader(io.StringIO(read_bounded(path).decode("utf-8", "replace"), newline=""))
    try:
        names = next(rows, ["step"])
        if "step" not in names:
            raise ValueError("there is no column step")
        for row in rows:
            if len(row) < len(names):  # truncated by a killed process
                continue
            for name, value in zip(names, row, strict=True):
                if value and name not in ("step", "epoch"):
                    points.setdefault(name, {})[int(row[names.index("step")])] = float(value)
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path} is damaged in line {rows.line_num}: {error}") from error
    return {name: (np.array(sorted(at)), np.array([at[step] for step in sorted(at)])) for name, at in points.items()}
