"""`job=report`: compare runs on one page."""

from __future__ import annotations

import logging
from pathlib import Path

from vla.config.check import Job
from vla.config.experiment import Experiment
from vla.io.types import Text
from vla.reports.html import write_comparison

log = logging.getLogger(__name__)

JOB = Job((), {"runs": list[Text]})


def run(experiment: Experiment) -> None:
    """Write `comparison.html`."""
    log.info(
        "wrote %s", write_comparison([Path(run) for run in experiment["report"]["runs"]], Path(experiment["output"]))
    )
