"""Jobs, `job=…`: the requirements that a config is checked against, and the module that runs each job.

`collect`, `train` and `evaluate` are stages of a pipeline: each first runs the earlier stages whose product is missing.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla.config.annotations import require_trusted
from vla.config.build import Group
from vla.config.check import TRAINING, Job
from vla.config.packages import is_trusted
from vla.io.errors import UserError
from vla.jobs.machine import require_compiler, warn_of_bfloat16

if TYPE_CHECKING:
    from vla.config.experiment import Experiment


def _plain_group(name: str, kind: str) -> Group:
    return Group(name, (f"vla.config.nodes.{kind}",), plain=True)


# Each is the module of that name, with a function `run`.
JOBS = {
    "collect": Job(("task", "expert", "cluster"), adopts=True),
    "train": Job(TRAINING, stored=("task", "expert")),
    "evaluate": Job(
        ("task", "cluster", "agent", "recorder"),
        adopts=True,
        without_agent=("tokenizer", "model", "policy"),
        without_checkpoint=("expert", "data", "learner", "trainer", "logger"),
    ),
    "improve": Job((*TRAINING, "policy", "recorder", _plain_group("improve", "Rounds"))),
    "deploy": Job(("tokenizer", "model", "policy", "agent", "deploy"), adopts=True),
    "export": Job(("task", "expert", "cluster", "tokenizer", "model", "policy", "export"), adopts=True),
    "inspect": Job((_plain_group("inspect", "Inspection"),)),
    "preview": Job(("task", "expert", "recorder", _plain_group("preview", "Preview"))),
    "report": Job((_plain_group("report", "ReportedRuns"),)),
    "plan": Job((_plain_group("plan", "Power"),)),
    "benchmark": Job((*TRAINING, "policy", _plain_group("benchmark", "Benchmark")), adopts=True),
}


def find(name: str) -> Job:
    """Return the requirements of a job: one of `JOBS`, or `JOB` of the module `name` in a trusted package.

    Raises a UserError if there is no such job, or its package is not trusted.
    """
    if name in JOBS:
        return JOBS[name]
    require_trusted("job", name)
    try:
        module: Any = import_module(name) if is_trusted(name) else None
    except ModuleNotFoundError as error:
        if not f"{name}.".startswith(f"{error.name}."):  # of another import
            raise
        module = None
    if not hasattr(module, "JOB"):
        raise UserError(f"there is no job '{name}'; --help lists the jobs")
    return module.JOB


def builds_world(experiment: Experiment) -> bool:
    """Return whether a job builds a new world: a resumed run keeps its own, and training on a store needs none."""
    groups, settings = find(experiment.settings.job).needs(experiment.nodes), experiment.settings
    if settings.resume is not None or (settings.job == "train" and Path(experiment.collect.folder).exists()):
        return False
    if "deploy" in groups:
        return getattr(experiment.kind("deploy"), "needs_environment", False)
    return "task" in groups


def run(experiment: Experiment) -> float | None:
    """Run the job of an experiment; evaluation returns the success rate, which sweeps maximise.

    Raises a UserError if the config compiles a model and this machine has no compiler, and the errors of the job.
    """
    name = experiment.settings.job
    groups = find(name).needs(experiment.config)
    require_compiler(experiment.config, groups)
    warn_of_bfloat16(experiment.config, groups)
    return import_module(f"vla.jobs.{name}" if name in JOBS else name).run(experiment)
