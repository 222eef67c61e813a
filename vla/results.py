"""What a run leaves in its folder for others to read: what it was told, how its training went, what it achieved."""

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

from vla.documents import read_bounded, read_json, read_yaml
from vla.evaluate import SEEN, Report, Result
from vla.files import write_text
from vla.run_files import Change, Node, ReportFile, Training
from vla.spec import Array

T = TypeVar("T")
Curve = tuple[Array, Array]  # steps (N,) and values (N,)

CONFIG, CHANGES, TRAINING = "config.yaml", "changes.yaml", "training.json"
METRICS, REPORT = "metrics.csv", "report.json"
# Where a run writes, and what other jobs would do: in these configurations differ without the runs being different.
ASIDE = ("output", "job", "preview", "inspect", "export", "benchmark", "report")
ABSENT = "-"  # stands for a key that one of two configurations does not have


@dataclass(frozen=True)
class Run:
    """What lies in a run's folder; what does not is empty or None."""

    folder: Path
    config: Node  # resolved
    changes: list[Change] | None
    training: Training | None
    metrics: dict[str, Curve]
    report: ReportFile | None

    @property
    def model(self) -> str:
        """Name of the model's class, or nothing."""
        return str(at(self.config, "model._target_", "")).rpartition(".")[2]

    @property
    def goal(self) -> str:
        """Name of the goal's class, or nothing."""
        return str(at(self.config, "task.goal._target_", "")).rpartition(".")[2]

    @property
    def parameters(self) -> int | None:
        """How many the model has, if that is known."""
        known = self.training or self.report
        return known.parameters if known else None

    @property
    def chosen(self) -> str | None:
        """File of the weights that are to be evaluated; None where that has yet to be found out."""
        return self.training.checkpoint if self.training else None

    def budget(self, evaluation: float) -> float | None:
        """Seconds that collection and training took, and an evaluation after them; None if that is not known."""
        if self.training is None or self.training.collection_s is None:
            return None
        return round(self.training.collection_s + self.training.seconds + evaluation, 1)

    @cached_property
    def reports(self) -> dict[str, Report]:
        """Condition → its report, the one that the policy was trained for first; of the others only seeds and
        outcomes are known."""
        if not self.report:
            return {}
        others = {
            name: Report(tuple(map(Result, self.report.seeds, part.outcomes)))
            for name, part in self.report.conditions.items()
        }
        return {SEEN: Report(tuple(self.report.per_episode)), **others}


def read_run(folder: Path) -> Run:
    """Read what lies in a folder; nothing has to be there.

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
    """The run that left a checkpoint.

    Raises:
        ValueError: a file of it is damaged.
    """
    return read_run(Path(checkpoint).resolve().parent.parent)


def require_run(folder: Path) -> Run:
    """As `read_run`.

    Raises:
        ValueError: nothing was trained or evaluated there, or a file is damaged.
    """
    if not any((folder / name).is_file() for name in (REPORT, METRICS)):
        raise ValueError(f"{folder} is no run: it has neither {REPORT} nor {METRICS}")
    return read_run(folder)


def write_config(folder: Path, config: Mapping[str, Any], changes: list[Node]) -> None:
    """Write the resolved configuration, and what of it is not as by default."""
    for name, content in ((CONFIG, config), (CHANGES, changes)):
        write_text(folder / name, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120))


def note_training(
    folder: Path, parameters: int, steps: int, seconds: float, ended: str, collection: float | None = None
) -> None:
    """Write how large the model is, which step its training reached and in which time [s], how it ended, "done",
    "interrupted", or what went wrong, and how long its demonstrations took to collect [s], if that is known."""
    collected = None if collection is None else round(collection, 1)
    _write_training(folder, Training(parameters, steps, round(seconds, 1), ended, collected))


def note_choice(folder: Path, checkpoint: str) -> None:
    """Add to what `note_training` wrote which of its checkpoints is to be evaluated."""
    _write_training(folder, replace(read_json(folder / TRAINING, Training), checkpoint=checkpoint))


def at(config: Any, key: str, absent: Any = ABSENT) -> Any:
    """The value of a plain configuration at a dotted key, or `absent`."""
    for name in key.split("."):
        if not isinstance(config, Mapping) or name not in config:
            return absent
        config = config[name]
    return config


def differences(one: Any, other: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    """Dotted key and both values of everything in which two plain configurations differ, leaf by leaf.

    What only one of them has is one entry as a whole, with `ABSENT` on the other side; `ASIDE` is left out.
    """
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return [] if one == other else [(key, one, other)]
    found = []
    for name in dict.fromkeys((*one, *other)):
        if key or name not in ASIDE:
            values = one.get(name, ABSENT), other.get(name, ABSENT)
            found += differences(*values, f"{key}.{name}" if key else str(name))
    return found


def _write_training(folder: Path, training: Training) -> None:
    write_text(folder / TRAINING, json.dumps(asdict(training), ensure_ascii=False) + "\n")


def _read(path: Path, read: Callable[[Path], T], otherwise: T) -> T:
    if not path.is_file():
        return otherwise
    try:
        return read(path)
    except ValueError as error:
        raise ValueError(f"{error}; remove the file to do without it, or repeat the run") from error


def _curves(path: Path) -> dict[str, Curve]:
    """The columns of metrics.csv; where a step was logged again, after an interruption, the later value counts."""
    points: dict[str, dict[int, float]] = {}
    rows = csv.reader(io.StringIO(read_bounded(path).decode("utf-8", "replace"), newline=""))
    try:
        names = next(rows, ["step"])
        if "step" not in names:
            raise ValueError("there is no column step")
        for row in rows:
            if len(row) < len(names):  # a process was killed while it wrote this row
                continue
            for name, value in zip(names, row, strict=True):
                if value and name not in ("step", "epoch"):
                    points.setdefault(name, {})[int(row[names.index("step")])] = float(value)
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path} is damaged in line {rows.line_num}: {error}") from error
    return {name: (np.array(sorted(at)), np.array([at[step] for step in sorted(at)])) for name, at in points.items()}
