"""What a run leaves in its folder for others to read: what it was told, how its training went, what it achieved."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vla.evaluate import SEEN, Report, Result
from vla.spec import Array

Node = dict[str, Any]
Curve = tuple[Array, Array]  # steps (N,) and values (N,)

CONFIG, CHANGES, TRAINING = "config.yaml", "changes.yaml", "training.json"
METRICS, REPORT = "metrics.csv", "report.json"
# Where a run writes, and what other jobs would do: in these configurations differ without the runs being different.
ASIDE = ("output", "job", "preview", "inspect", "export", "benchmark", "report")
ABSENT = "-"  # stands for a key that one of two configurations does not have


@dataclass(frozen=True)
class Run:
    """What lies in a run's folder; what does not is empty."""

    folder: Path
    config: Node  # resolved
    changes: list[Node] | None  # `key`, and its values `here` and by `default`
    training: Node  # as written by `note_training`
    metrics: dict[str, Curve]
    report: Node  # report.json

    @property
    def model(self) -> str:
        """Name of the model's class, or nothing."""
        return str(self.config.get("model", {}).get("_target_", "")).rpartition(".")[2]

    @property
    def goal(self) -> str:
        """Name of the goal's class, or nothing."""
        return str(self.config.get("task", {}).get("goal", {}).get("_target_", "")).rpartition(".")[2]

    @property
    def parameters(self) -> int | None:
        """How many the model has, if that is known."""
        return self.training.get("parameters", self.report.get("parameters"))

    @property
    def chosen(self) -> str | None:
        """File of the weights that are to be evaluated; None where that has yet to be found out."""
        return self.training.get("checkpoint")

    def budget(self, evaluation: float) -> float | None:
        """Seconds that collection and training took, and an evaluation after them; None if that is not known."""
        collection, training = self.training.get("collection_s"), self.training.get("seconds")
        return None if collection is None or training is None else round(collection + training + evaluation, 1)

    @cached_property
    def reports(self) -> dict[str, Report]:
        """Condition → its report, the one that the policy was trained for first; draws and conditions' steps are left
        out."""
        if not self.report:
            return {}
        played = [Result(each["seed"], each["outcome"], each["instruction"]) for each in self.report["per_episode"]]
        others = {
            name: Report(tuple(map(Result, self.report["seeds"], part["outcomes"])))
            for name, part in self.report.get("conditions", {}).items()
        }
        return {SEEN: Report(tuple(played)), **others}


def read_run(folder: Path) -> Run:
    """Read what lies in a folder; nothing has to be there.

    Raises:
        ValueError: a file is damaged.
    """
    report = _read(folder / REPORT, json.loads, {})
    return Run(
        folder,
        _read(folder / CONFIG, yaml.safe_load, report.get("config", {})),
        _read(folder / CHANGES, yaml.safe_load, None),
        _read(folder / TRAINING, json.loads, {}),
        _read(folder / METRICS, _curves, {}),
        report,
    )


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
        write(folder / name, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120))


def note_training(
    folder: Path, parameters: int, steps: int, seconds: float, ended: str, collection: float | None = None
) -> None:
    """Write how large the model is, which step its training reached and in which time [s], how it ended, "done",
    "interrupted", or what went wrong, and how long its demonstrations took to collect [s], if that is known."""
    facts = {"parameters": parameters, "steps": steps, "seconds": round(seconds, 1), "ended": ended}
    facts |= {"collection_s": None if collection is None else round(collection, 1)}
    write(folder / TRAINING, json.dumps(facts, ensure_ascii=False) + "\n")


def note_choice(folder: Path, checkpoint: str) -> None:
    """Add to what `note_training` wrote which of its checkpoints is to be evaluated."""
    facts = _read(folder / TRAINING, json.loads, {}) | {"checkpoint": checkpoint}
    write(folder / TRAINING, json.dumps(facts, ensure_ascii=False) + "\n")


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


def write(path: Path, text: str) -> None:
    """Write a file into a folder, which is made, all of it or nothing; several processes may do so at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(text, encoding="utf-8")
    os.replace(draft, path)


def _read(path: Path, parse: Any, otherwise: Any) -> Any:
    if not path.is_file():
        return otherwise
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path} is damaged: {' '.join(str(error).split())}") from error


def _curves(text: str) -> dict[str, Curve]:
    """The columns of metrics.csv; where a step was logged again, after an interruption, the later value counts."""
    points: dict[str, dict[int, float]] = {}
    for row in csv.DictReader(text.splitlines()):
        for name, value in row.items():
            if value and name not in ("step", "epoch"):
                points.setdefault(name, {})[int(row["step"])] = float(value)
    return {name: (np.array(sorted(at)), np.array([at[step] for step in sorted(at)])) for name, at in points.items()}
