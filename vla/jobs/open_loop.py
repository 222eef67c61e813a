"""Evaluation in a world of recordings: errors on the episodes that training held out."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vla.config.differences import at
from vla.config.experiment import Experiment
from vla.data.datamodule import digest_of, held_out
from vla.data.episodes import EpisodeStore
from vla.data.header import is_store
from vla.data.verification import episode_of
from vla.io.errors import UserError
from vla.io.files import warn_on_error, writing
from vla.io.printable import show, track
from vla.jobs.collect import demonstrations
from vla.models.policy_folder import read_policy
from vla.policy import costs
from vla.reports.open_loop import components, errors_table, plot_errors, write_errors
from vla.reports.run_page import write_page
from vla.rollouts.open_loop import OpenLoop, open_loop
from vla.rollouts.rollout import close_agent
from vla.runs.folder import ERRORS, ERRORS_PLOT, PAGE, described, save_config, wall_time

log = logging.getLogger(__name__)


def evaluate_open_loop(experiment: Experiment, checkpoint: Path | None) -> float:
    """Measure the errors, write the reports, and return minus the relative error, which sweeps maximise.

    Without a checkpoint the agent of the config is shown the episodes that a training would hold out.

    Raises:
        UserError: the checkpoint was trained on other episodes, or on all of them.
    """
    started, output = time.monotonic(), experiment.output
    facts: dict[str, Any] = {**experiment.settings.chosen, "origin": asdict(experiment.origin)}
    fraction = _held_out(experiment, checkpoint)  # before an import
    folder = Path(experiment.collect.folder)
    store = EpisodeStore(folder, experiment.collect.episodes) if is_store(folder) else demonstrations(experiment)
    if checkpoint is None:
        make_agent: Any = experiment.make_agent()
        policy = make_agent(experiment.world())
        facts["model"] = facts["agent"]
    else:
        policy = experiment.make_policy(checkpoint)()
        policy.spec.without_truth.require(store.spec.without_truth, f"the checkpoint {checkpoint}", f"{store.folder}")
        _require_trained_on(store, experiment.collect.more or (), checkpoint)
        facts |= costs(policy)
    try:
        result = _measure(experiment, store, fraction, policy)
    finally:
        close_agent(policy)
    seconds = time.monotonic() - started
    facts["wall_time_s"] = wall_time(checkpoint, seconds) if checkpoint else seconds
    with writing(output / ERRORS):
        save_config(output, experiment.config, experiment.changes)
        with warn_on_error(output / ERRORS_PLOT):
            (output / ERRORS_PLOT).unlink(missing_ok=True)  # of an earlier evaluation
            plot_errors(result, output / ERRORS_PLOT)
        # Last, because its existence marks the evaluation as finished.
        write_errors(result, output / ERRORS, str(checkpoint) if checkpoint else None, experiment.config, facts)
        page = None
        with warn_on_error(output / PAGE):
            page = write_page(output)
    show(errors_table(components(result), len(result.seeds)))
    files = described([page, output / ERRORS, output / ERRORS_PLOT])
    log.info("wrote %s: open-loop errors, which are not a success rate", files)
    return -result.relative


def _held_out(experiment: Experiment, checkpoint: Path | None) -> float:
    """Return the share of episodes that training holds out, or held out; a UserError if there are none."""
    fraction, whose = experiment.held_out, "a training would be"
    if checkpoint is not None:
        saved, whose = read_policy(checkpoint), f"{checkpoint} was trained"
        trained, world = saved.spec.without_truth, experiment.world().spec.without_truth
        trained.require(world, f"the checkpoint {checkpoint}", "the task, with the options given here,")
        fraction = at(saved.config, "data.validation_fraction", None)
        if not isinstance(fraction, float | int):
            raise UserError(f"{checkpoint} does not say which share of the episodes its training held out")
    if not fraction:
        raise UserError(
            f"data.validation_fraction=0: {whose} on all episodes, and errors on these say nothing about others: train "
            "with a larger fraction"
        )
    return fraction


def _require_trained_on(store: EpisodeStore, more: Sequence[str], checkpoint: Path) -> None:
    """Raise a UserError unless a checkpoint was trained on the episodes of a store, and of `more` stores."""
    saved, entries = read_policy(checkpoint), store.episodes
    further = [entry for folder in more for entry in EpisodeStore(folder).episodes]
    if saved.training.windows != digest_of([*entries, *further]):
        folders = " and those in ".join(map(str, [store.folder, *more]))
        raise UserError(
            f"{checkpoint} was trained on other episodes than the {len(entries)} in {folders}, so which of them were "
            "held out is unknown: name the recording, its options, collect.episodes and collect.more as in training"
        )
    if origin := saved.config.get("pretrained"):
        log.warning(
            "%s began with the weights of %s: whether these were trained on its episodes is unknown", checkpoint, origin
        )


def _measure(experiment: Experiment, store: EpisodeStore, fraction: float, policy: Any) -> OpenLoop:
    """Return the errors on the held-out episodes; a UserError if there are none, or no others."""
    unseen = [entry for entry in store.episodes if held_out(entry.recording, fraction)]
    seen = [entry for entry in store.episodes if not held_out(entry.recording, fraction)]
    if not unseen:
        raise UserError(
            f"data.validation_fraction={fraction} holds none of the {len(store.episodes)} episodes in {store.folder} "
            "out of training: train with a larger fraction, or with more episodes"
        )
    if not seen:
        raise UserError(
            f"all {len(unseen)} episodes in {store.folder} are held out, so there is no constant action to compare "
            "with: record more, or raise collect.episodes"
        )
    actions = store.rows("action")
    constant = np.concatenate([actions[entry.span] for entry in seen]).mean(0)
    shown = unseen[: experiment.evaluate.episodes]
    return open_loop(policy, store.spec, (episode_of(store, entry) for entry in track(shown, "evaluating")), constant)
