"""Jobs, `job=…`: each names a module with its requirements, `JOB`, and a function `run`.

`collect`, `train` and `evaluate` are stages of a pipeline: each first runs the earlier stages whose product is missing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from vla.config.annotations import require_trusted
from vla.config.packages import is_trusted
from vla.io.errors import UserError
from vla.jobs.machine import require_compiler, warn_of_bfloat16

if TYPE_CHECKING:
    from vla.config.experiment import Experiment


def find(name: str) -> Any:
    """Import the module of a job: `vla.jobs.NAME`, or of a trusted package if `name` has dots.

    Raises:
        UserError: there is no such job, or its package is not trusted.
    """
    module = name if "." in name else f"vla.jobs.{name}"
    require_trusted("job", module)
    try:
        found = import_module(module) if module.startswith("vla.") or is_trusted(module) else None
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):  # of another import
            raise
        found = None
    if not hasattr(found, "JOB"):
        raise UserError(f"there is no job={name}; --help lists the jobs")
    return found


def run(experiment: Experiment) -> float | None:
    """Run the job of an experiment; evaluation returns the success rate, which sweeps maximise.

    Raises:
        UserError: the config compiles a model, and this machine cannot; or an error of the job.
    """
    job = find(experiment["job"])
    groups = job.JOB.needs(experiment.config)
    require_compiler(experiment.config, groups)
    warn_of_bfloat16(experiment.config, groups)
    return job.run(experiment)
