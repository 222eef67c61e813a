"""Jobs, `job=…`: one module each, with a function `run`.

`collect`, `train` and `evaluate` are stages of a pipeline: each first runs the earlier stages whose product is missing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from vla.jobs.bfloat16 import warn_of_bfloat16

if TYPE_CHECKING:
    from vla.config.experiment import Experiment


def run(experiment: Experiment) -> float | None:
    """Run the job of an experiment; evaluation returns the success rate, which sweeps maximise."""
    warn_of_bfloat16(experiment.config)
    result: float | None = import_module(f"vla.jobs.{experiment['job']}").run(experiment)
    return result
