"""`job=benchmark`: throughput and latency of every stage, next to a floor that is measured in the same run.

The floor is a reference value in the same unit: the unavoidable part of the work, a whole step, another renderer or
another project. `ratio` is value / floor. Each stage is a module of this package with a function `measures`.
"""

from __future__ import annotations

import logging
from importlib import import_module

from rich import print as show
from rich.table import Table

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.io.files import write_json
from vla.jobs.benchmark.machine import OtherLoad, is_unreliable, machine
from vla.jobs.benchmark.measure import Measure

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> dict[str, Measure]:
    """Measure the stages in `benchmark.names`, print a table and write `benchmark.json`; returns name → measure.

    Both name the processor, and how many of its cores other programs used during a stage.
    """
    here = machine()
    show(f"{here['processor']}, {here['cores']} cores, {' '.join(here['instructions'])}")
    measures: dict[str, Measure] = {}
    busy: dict[str, float] = {}
    for name in experiment.options(Benchmark).names:
        others = OtherLoad()
        found = import_module(f"vla.jobs.benchmark.{name}").measures(experiment)
        used = others.cores()
        measures |= {key: {**each, "others": None if used is None else round(used, 2)} for key, each in found.items()}
        if used is not None and is_unreliable(used):
            busy[name] = used
    write_json(experiment.output / "benchmark.json", {"machine": here, "measures": measures})
    table = Table("stage", "value", "unit", "n", "floor", "ratio", r"others \[cores]")
    for name, each in measures.items():
        table.add_row(name, *map(str, each.values()))
    show(table)
    for name, used in busy.items():
        log.warning(
            "%s is slower here than on an idle machine, and its ratios are less exact: other programs used %.1f cores "
            "meanwhile",
            *(name, used),
        )
    return measures
