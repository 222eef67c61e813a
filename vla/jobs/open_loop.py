"""Evaluation in a world of recordings: errors on the episodes that training held out."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich import print as show
from rich.progress import track

from vla.config.experiment import Experiment
from vla.data.datamodule import digest_of, held_out
from vla.data.episodes import EpisodeStore
from vla.data.verification import episode_of
from vla.io.files import writing
from vla.jobs.collect import demonstrations
from vla.models.checkpoint import read_header
from vla.policy import latency
from vla.reports.html import PAGE, optional, write_page
from vla.reports.open_loop import errors_table, plot_errors, write_errors
from vla.rollouts.open_loop import OpenLoop, open_loop
from vla.runs.folder import ERRORS, save_config, wall_time

log = logging.getLogger(__name__)


def evaluate_open_loop(experiment: Experiment, checkpoint: Path) -> float:
    """Measure the errors, write the reports, and return minus the relative error, which sweeps maximise.

    Raises:
        ValueError: the checkpoint was trained on other episodes, or on all of them.
    """
    started, output = time.monotonic(), experiment.output
    store = _store(experiment)
    policy = experiment.make_policy(checkpoint)()
    policy.spec.without_truth.require(store.spec.without_truth, f"the checkpoint {checkpoint}", f"{store.folder}")
    result = _measure(experiment, store, checkpoint, policy)
    facts = {
        **experiment["chosen"],
        "parameters": sum(p.numel() for p in policy.model.parameters()),
        "latency_ms": latency(policy),
        "wall_time_s": wall_time(checkpoint, time.monotonic() - started),
    }
    with writing(output / ERRORS):
        save_config(output, experiment.config, experiment.changes)
        plot_errors(result, output / "errors.png")
        # Last, because its existence marks the evaluation as finished.
        write_errors(result, output / ERRORS, str(checkpoint), experiment.config, facts)
        with optional(output / PAGE):
            write_page(output)
    show(errors_table(result))
    log.info("wrote %s, %s and errors.png: open-loop errors, which are not a success rate", output / PAGE, ERRORS)
    return -result.relative


def _store(experiment: Experiment) -> EpisodeStore:
    """Return the episodes, importing missing ones."""
    folder, episodes = Path(experiment["collect"]["folder"]), experiment["collect"]["episodes"]
    if (folder / "store.json").exists():
        return EpisodeStore(folder, episodes)
    return demonstrations(experiment)


def _measure(experiment: Experiment, store: EpisodeStore, checkpoint: Path, policy: Any) -> OpenLoop:
    header, entries = read_header(checkpoint), store.episodes
    if header.windows != digest_of(entries):
        raise ValueError(
            f"{checkpoint} was trained on other episodes than the {len(entries)} in {store.folder}, so which of them "
            "were held out is unknown: name the recording, its options and collect.episodes as in training"
        )
    fraction = header.config["data"]["validation_fraction"]
    unseen = [entry for entry in entries if held_out(entry.seed, fraction)][: experiment["evaluate"]["episodes"]]
    if not unseen:
        raise ValueError(f"{checkpoint} was trained on all episodes: train with data.validation_fraction above 0")
    actions = store.rows("action")
    seen = [actions[entry.span] for entry in entries if not held_out(entry.seed, fraction)]
    episodes = (episode_of(store, entry) for entry in track(unseen, "evaluating"))
    return open_loop(policy, store.spec, episodes, np.concatenate(seen).mean(0))
