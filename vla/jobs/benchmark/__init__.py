"""`job=benchmark`: throughput and latency of every stage, next to a floor that is measured in the same run.

The floor is the same measure for the part of the work that cannot be avoided. A ratio of 1 means that everything else
is free. Each stage is a module of this package with a function `measures`.
"""

from __future__ import annotations

import json
from importlib import import_module
from typing import Annotated, Literal

from annotated_types import MinLen
from rich import print as show
from rich.table import Table

from vla.config.check import TRAINING, Job
from vla.config.experiment import Experiment
from vla.io.files import write_text
from vla.io.types import Count
from vla.jobs.benchmark.measure import Measure

JOB = Job(
    (*TRAINING, "policy"),
    {
        "names": Annotated[list[Literal["collect", "loader", "train", "policy", "deploy", "serve"]], MinLen(1)],
        "episodes": Count,
        "batches": Count,
        "steps": Count,
        "rounds": Count,
        "precisions": list[Literal["fp32", "bf16"]] | None,
        "compile": list[bool],
        "robosuite": str | None,
        "lerobot": str | None,
    },
    adopts=True,
)


def run(experiment: Experiment) -> dict[str, Measure]:
    """Measure the stages in `benchmark.names`, print a table and write `benchmark.json`; returns name → measure."""
    measures: dict[str, Measure] = {}
    for name in experiment["benchmark"]["names"]:
        measures |= import_module(f"vla.jobs.benchmark.{name}").measures(experiment)
    write_text(experiment.output / "benchmark.json", json.dumps(measures, indent=2))
    table = Table("stage", "value", "unit", "n", "floor", "ratio")
    for name, measure in measures.items():
        table.add_row(name, *map(str, measure.values()))
    show(table)
    return measures
