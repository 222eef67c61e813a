"""`job=export`: export demonstrations or a policy to another format."""

from __future__ import annotations

import logging

from vla.config.experiment import Experiment
from vla.jobs.collect import demonstrations

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Export demonstrations or a policy, depending on the exporter.

    Raises a UserError if the exporter needs a policy, and no checkpoint is given.
    """
    exporter = experiment.build("export")
    if getattr(exporter, "of_policies", False):
        log.info("wrote %s", exporter.export(experiment.make_policy()()))
    else:
        log.info("wrote %s", exporter.export(demonstrations(experiment), experiment.build("cluster")))
