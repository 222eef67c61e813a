"""`job=benchmark`: throughput and latency of every stage, next to a floor that is measured in the same run.

The floor is a reference value in the same unit: the unavoidable part of the work, a whole step or another renderer.
`ratio` is value / floor. Each stage is a function of its name in a module of this package.
"""

from __future__ import annotations

import logging
from importlib import import_module

from vla.config.check import devices
from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.io.errors import UserError
from vla.io.files import write_json
from vla.io.printable import show
from vla.jobs.benchmark.measure import Measure, machine, other_load
from vla.parallel.limits import cores
from vla.reports.tables import Table

log = logging.getLogger(__name__)

BUSY = 0.05  # share of all cores; more use by other programs makes a figure unreliable
MODULES = dict.fromkeys(("policy", "evaluate"), "acting")  # others are named like their stage


def run(experiment: Experiment) -> dict[str, Measure]:
    """Measure the stages in `benchmark.names`, print a table and write `benchmark.json`; returns name → measure.

    Both name the processor, and how many of its cores other programs used during a stage. Raises a UserError if there
    is no policy to evaluate, nothing can be played, or training is on several devices.
    """
    host, measures, names = machine(), dict[str, Measure](), experiment.options(Benchmark).names
    # Before any stage, because they take minutes.
    if ("evaluate" in names and not experiment.playable) or ("collect" in names and not experiment.has_expert):
        raise UserError(
            "benchmark.names: collect and evaluate play episodes, which recordings cannot: set "
            "benchmark.names=[loader,train,policy]"
        )
    if "evaluate" in names and experiment.checkpoint is None:
        raise UserError("benchmark.names=[evaluate] plays a trained policy: add checkpoint=RUN")
    if "train" in names and devices(experiment["trainer"]) > 1:
        raise UserError("job=benchmark measures training on one device: add trainer.devices=1")
    for name in names:
        stage, (start_load, start) = getattr(import_module(f"{__name__}.{MODULES.get(name, name)}"), name), other_load()
        stage_measures, (end_load, end) = stage(experiment), other_load()
        other_cores = max(0.0, end_load - start_load) / max(end - start, 1e-9)
        measures |= {key: {**measure, "others": round(other_cores, 2)} for key, measure in stage_measures.items()}
        if other_cores > BUSY * cores():
            text = "is slower here than on an idle machine, and its ratios are less exact"
            log.warning("%s %s: other programs used %.1f cores meanwhile", name, text, other_cores)
    file = experiment.output / "benchmark.json"
    write_json(file, {"machine": host, "measures": measures})
    heads = ("stage", "value", "unit", "n", "floor", "ratio", "others [cores]")
    rows = [[name, *map(str, measure.values())] for name, measure in measures.items()]
    show(Table(heads, rows, ", ".join(map(str, host.values()))))
    log.info("wrote %s", file)
    return measures
