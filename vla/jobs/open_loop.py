"""Evaluation in a world of recordings: errors on the episodes that training held out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vla.config.differences import value_at
from vla.config.experiment import Experiment
from vla.data.datamodule import digest_of, is_held_out
from vla.data.episodes import EpisodeStore
from vla.data.header import is_store
from vla.data.index import Entry, recording_of
from vla.data.verification import episode_of
from vla.io.errors import UserError
from vla.io.files import warn_on_error, writing
from vla.io.printable import show, track
from vla.jobs.collect import demonstrations
from vla.models.policy_folder import read_policy
from vla.policy import costs
from vla.reports.open_loop import components, errors_table, plot_errors, write_errors
from vla.reports.run_page import try_write_page
from vla.rollouts.open_loop import OpenLoop, open_loop
from vla.rollouts.rollout import close_agent
from vla.runs.folder import ERRORS, ERRORS_PLOT, describe_files, save_config
from vla.spec import Array

log = logging.getLogger(__name__)


def evaluate_open_loop(experiment: Experiment, checkpoint: Path | None) -> float:
    """Measure the errors, write the reports, and return minus the relative error, which sweeps maximise.

    Without a checkpoint the agent of the config is shown the episodes that a training would hold out. There is a
    UserError if the checkpoint was trained on other episodes, or on all of them.
    """
    output, folder = experiment.output, Path(experiment.collect.folder)
    # Determined now, before the code may change.
    facts: dict[str, Any] = {**experiment.settings.chosen, "origin": asdict(experiment.origin)}
    _ = experiment.changes
    fraction = _held_out_fraction(experiment, checkpoint)  # before an import
    has_store = checkpoint is not None and is_store(folder)  # else an earlier import is compared with its dataset
    store = EpisodeStore(folder, experiment.collect.episodes) if has_store else demonstrations(experiment)
    if checkpoint is None:
        make_agent: Any = experiment.make_agent()
        policy = make_agent(experiment.world())
        facts["model"] = facts["agent"]
    else:
        policy = experiment.make_policy(checkpoint)()
        policy.spec.require_input(store.spec, f"the checkpoint {checkpoint}", f"{store.folder}")
        _require_trained_on(store, experiment.collect.more or (), checkpoint)
        facts |= costs(policy)
    try:
        result = _measure(experiment, store, fraction, policy)
    finally:
        close_agent(policy)
    with writing(output / ERRORS):
        save_config(output, experiment.config, experiment.changes)
        with warn_on_error(output / ERRORS_PLOT):
            (output / ERRORS_PLOT).unlink(missing_ok=True)  # of an earlier evaluation
            plot_errors(result, output / ERRORS_PLOT)
        # Last, because its existence marks the evaluation as finished.
        write_errors(result, output / ERRORS, str(checkpoint) if checkpoint else None, experiment.config, facts)
    page = try_write_page(output)
    show(errors_table(components(result), len(result.seeds)))
    files = describe_files([page, output / ERRORS, output / ERRORS_PLOT])
    log.info("wrote %s: open-loop errors, which are not a success rate", files)
    return -result.relative


def _held_out_fraction(experiment: Experiment, checkpoint: Path | None) -> float:
    """Return the share of episodes that training holds out, or held out; raise a UserError if there are none."""
    fraction, subject = experiment["data"]["validation_fraction"], "a training would be"
    if checkpoint is not None:
        policy, subject = read_policy(checkpoint), f"{checkpoint} was trained"
        world = experiment.world().spec
        policy.spec.require_input(world, f"the checkpoint {checkpoint}", "the task, with the options given here,")
        # Else `_require_trained_on` would find other images, after an import.
        size, value = (value_at(config, "task.image_size") for config in (policy.config, experiment.config))
        if size != value:
            raise UserError(
                f"{checkpoint} was trained with task.image_size={str(size)[:50]}, not {value}, and only images of that "
                "size tell which episodes were held out: set it as in training"
            )
        fraction = value_at(policy.config, "data.validation_fraction", None)
    if not isinstance(fraction, float | int) or not fraction:
        raise UserError(
            f"data.validation_fraction={fraction}: {subject} on all episodes, and errors on these say nothing about "
            "others: train with a larger fraction"
        )
    return fraction


def _require_trained_on(store: EpisodeStore, more: Sequence[str], checkpoint: Path) -> None:
    """Raise a UserError unless a checkpoint was trained on the episodes of a store, and of `more` stores."""
    policy, entries = read_policy(checkpoint), store.episodes
    more_entries = [entry for folder in more for entry in EpisodeStore(folder).episodes]
    if policy.training.windows != digest_of([*entries, *more_entries]):
        folders = " and those in ".join(map(str, [store.folder, *more]))
        raise UserError(
            f"{checkpoint} was trained on other episodes than the {len(entries)} in {folders}, so which of them were "
            "held out is unknown: name the recording, its options, collect.episodes and collect.more as in training"
        )
    if origin := policy.config.get("pretrained"):
        log.warning(
            "%s began with the weights of %s: whether these were trained on its episodes is unknown", checkpoint, origin
        )


def _measure(experiment: Experiment, store: EpisodeStore, fraction: float, policy: Any) -> OpenLoop:
    """Return the errors on the held-out episodes; raise a UserError if there are none, or no others."""
    parts: dict[bool, list[Entry]] = {True: [], False: []}
    for entry in store.episodes:
        parts[is_held_out(recording_of(entry), fraction)].append(entry)
    if not all(parts.values()):
        raise UserError(
            f"data.validation_fraction={fraction} holds {len(parts[True])} of the {len(store.episodes)} episodes in "
            f"{store.folder} out of training, but some must be held out and some not: record more, or train with "
            "another fraction"
        )
    actions = list[Array]()
    for training_store in (store, *map(EpisodeStore, experiment.collect.more or ())):
        entries, rows = training_store.episodes, training_store.rows("action")
        actions += [rows[entry.span] for entry in entries if not is_held_out(recording_of(entry), fraction)]
    constant = np.concatenate(actions).mean(0, dtype=np.float64)  # a sum of a million float32 is off by a percent
    held_out = track(parts[True][: experiment.evaluate.episodes], "evaluating")
    return open_loop(policy, store.spec, (episode_of(store, entry) for entry in held_out), constant)
