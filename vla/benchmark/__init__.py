"""How fast the stages run, each against a floor that was measured on the same work in the same run.

A floor is what the stage could not do without: a ratio of 1 would mean that everything around it costs nothing. A stage
is a module that is called as the user calls it.
"""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

from omegaconf import DictConfig

from vla.benchmark.measure import Measure
from vla.files import write_text

STAGES = ("collect", "loader", "train", "policy", "deploy")


def benchmark(config: DictConfig, output: Path) -> dict[str, Measure]:
    """Measure what `config.benchmark.names` lists, print a table, write `benchmark.json`; name → measure.

    Raises:
        ValueError: no name, or one that is no stage.
    """
    if not config.benchmark.names:
        raise ValueError(f"benchmark.names is empty: the stages are {', '.join(STAGES)}")
    unknown = sorted(set(config.benchmark.names) - set(STAGES))
    if unknown:
        raise ValueError(f"benchmark.names has {unknown}, the stages are {sorted(STAGES)}")
    measures: dict[str, Measure] = {}
    for name in config.benchmark.names:
        measures |= import_module(f"vla.benchmark.{name}").measures(config)
    write_text(output / "benchmark.json", json.dumps(measures, indent=2))
    _show(measures)
    return measures


def _show(measures: dict[str, Measure]) -> None:
    from rich import print as show
    from rich.table import Table

    table = Table("stage", "value", "unit", "n", "floor", "ratio")
    for name, measure in measures.items():
        table.add_row(name, *(str(measure[key]) for key in ("value", "unit", "n", "floor", "ratio")))
    show(table)
