"""The files of results: written again after every command, from what the runs of vla wrote."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any


def update(file: Path, **values: Any) -> None:
    """Set top-level keys of a JSON file, atomically: whoever is killed leaves what was measured before."""
    content = json.loads(file.read_text()) if file.exists() else {}
    draft = file.with_name(f".{file.name}")
    draft.write_text(json.dumps(content | values, indent=1))
    draft.replace(file)


def figures_of(output: Path) -> dict[str, Any]:
    """Return what a run wrote: measures of a benchmark, a training, its curves, and the outcomes of an evaluation."""
    figures: dict[str, Any] = {}
    for name in ("benchmark", "training"):
        if (file := output / f"{name}.json").exists():
            figures[name] = json.loads(file.read_text())
    if (file := output / "metrics.csv").exists():
        with file.open() as lines:
            rows = csv.DictReader(lines)
            figures["metrics"] = [{key: float(value) for key, value in row.items() if value} for row in rows]
    if (file := output / "report.json").exists():
        report = json.loads(file.read_text())
        outcomes = [episode["outcome"] for episode in report["per_episode"]]
        figures["outcomes"] = {outcome: outcomes.count(outcome) for outcome in sorted({*outcomes})}
        figures["latency_ms"] = report.get("latency_ms")
    return figures


def rates_of(file: Path) -> dict[str, float]:
    """Return kind, "eager" or "compiled" → rate of training in the file of step c [windows/s]."""
    rates = {}
    for kind, record in json.loads(file.read_text()).items() if file.exists() else ():
        for name, measure in record.get("benchmark", {}).get("measures", {}).items():
            if name.startswith("train: ") and name.count(":") == 1 and "loader" not in name:
                rates[kind] = float(measure["value"])
    return rates


def compiling_of(file: Path, kind: str) -> float:
    """Return how much longer than the eager training another kind took in the file of step c [s]: it compiles."""
    records = json.loads(file.read_text()) if file.exists() else {}
    seconds, eager_seconds = (float(records.get(name, {}).get("seconds", 0)) for name in (kind, "eager"))
    return max(0.0, seconds - eager_seconds)
