"""`job=benchmark`: throughput and latency of every stage, next to a floor that is measured in the same run.

The floor is a reference value in the same unit: the unavoidable part of the work, a whole step or another renderer.
`ratio` is value / floor. Each stage is a function of its name in a module of this package.
"""

from __future__ import annotations

import logging
from importlib import import_module

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.io.errors import UserError
from vla.io.files import write_json
from vla.io.printable import show
from vla.jobs.benchmark.measure import Measure, machine, other_load
from vla.parallel.limits import cores

log = logging.getLogger(__name__)

BUSY = 0.05  # share of all cores; more use by other programs makes a figure unreliable
MODULES = dict.fromkeys(("policy", "evaluate"), "acting")  # others are named like their stage


def run(experiment: Experiment) -> dict[str, Measure]:
    """Measure the stages in `benchmark.names`, print a table and write `benchmark.json`; returns name → measure.

    Both name the processor, and how many of its cores other programs used during a stage. Raises a UserError if there
    is no policy to evaluate.
    """
    from vla.reports.tables import Table  # imports matplotlib

    here, found, names = machine(), dict[str, Measure](), experiment.options(Benchmark).names
    if "evaluate" in names and experiment.checkpoint is None:  # before the others, which take minutes
        raise UserError("benchmark.names=[evaluate] plays a trained policy: add checkpoint=RUN")
    for name in names:
        stage, (others, began) = getattr(import_module(f"{__name__}.{MODULES.get(name, name)}"), name), other_load()
        measured, (others_now, now) = stage(experiment), other_load()
        used = max(0.0, others_now - others) / max(now - began, 1e-9)
        found |= {key: {**each, "others": round(used, 2)} for key, each in measured.items()}
        if used > BUSY * cores():
            slower = "is slower here than on an idle machine, and its ratios are less exact"
            log.warning("%s %s: other programs used %.1f cores meanwhile", name, slower, used)
    file = experiment.output / "benchmark.json"
    write_json(file, {"machine": here, "measures": found})
    heads = ("stage", "value", "unit", "n", "floor", "ratio", "others [cores]")
    rows = [[name, *map(str, each.values())] for name, each in found.items()]
    show(Table(heads, rows, ", ".join(map(str, here.values()))))
    log.info("wrote %s", file)
    return found
