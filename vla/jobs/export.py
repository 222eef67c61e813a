"""`job=export`: export the demonstrations to another format."""

from __future__ import annotations

import logging

from vla.config.experiment import Experiment
from vla.jobs.collect import demonstrations

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Export demonstrations."""
    exporter = experiment.build("export")
    log.info("wrote %s", exporter.export(demonstrations(experiment), experiment.cluster()))
