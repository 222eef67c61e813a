"""`job=inspect`: verify and describe an episode store, merge stores into a new one, or replay one episode."""

from __future__ import annotations

import logging
from contextlib import closing
from pathlib import Path

from vla.config.build import require_no_paths
from vla.config.experiment import Experiment, make_environment
from vla.config.nodes import Inspection
from vla.data.derivation import derive_store
from vla.data.episodes import EpisodeStore
from vla.data.index import format_numbers
from vla.data.verification import find_episode, require_whole, verify_store
from vla.io.errors import UserError, counted
from vla.io.files import warn_on_error
from vla.io.printable import show
from vla.jobs.preview import recording
from vla.reports.dataset_card import store_table, write_card
from vla.rollouts.rollout import replay

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Verify and describe a store, after merging or repairing if asked for, or replay one episode."""
    options = experiment.options(Inspection)
    if options.episode is None:
        inspect_store(options)
    else:
        if names := [name for name in ("stores", "where", "repair", "into") if getattr(options, name)]:
            raise UserError(f"inspect.episode replays an episode of inspect.folder: omit inspect.{names[0]}")
        _replay_episode(experiment, Path(options.folder), options.episode)


def inspect_store(inspection: Inspection) -> None:
    """Verify and describe a store, or a new one made by merging, filtering or repair.

    Raises a UserError if the store cannot be read or made, or, after its intact episodes are described, is damaged.
    """
    findings = verify_store(EpisodeStore(_store_folder(inspection), allow_damage=True))
    show(store_table(findings))
    if findings.intact_entries:
        with warn_on_error(findings.store.folder / "card.md"):  # a store may be read-only
            log.info("wrote %s and card.png", write_card(findings))
    require_whole(findings)


def _store_folder(options: Inspection) -> Path:
    """Return the path of the store to inspect; make it if needed."""
    folder = Path(options.folder)
    if options.into is None:
        if options.stores or options.where:
            raise UserError("inspect.stores and inspect.where make a new store: give its folder, inspect.into=DIR")
        if not options.repair:
            return folder
        if not verify_store(EpisodeStore(folder, allow_damage=True)).damaged_seeds:
            log.info("nothing in %s is damaged, so nothing is repaired", folder)
            return folder
    sources = [EpisodeStore(source, allow_damage=options.repair) for source in options.stores or [folder]]
    target = Path(options.into or f"{folder}-repaired")
    damaged = derive_store(sources, target, options.where, options.repair)
    log.info("wrote %s; its sources are unchanged", target)
    if damaged:
        log.warning(
            "counted as failed from now on: %s, %s", counted(len(damaged), "damaged seed"), format_numbers(damaged)
        )
    return target


def _replay_episode(experiment: Experiment, folder: Path, seed: int) -> None:
    """Replay the actions of a stored episode and compare the states.

    A recorder records it in the scene of the replay; Rerun's recording is `episode-SEED.rrd`. A robot in the experiment
    replaces that of the store's task, which may not name files. Raises a UserError if there is no such episode, it was
    imported, its store lacks the task, or the task now has another spec.
    """
    store, robot = EpisodeStore(folder, allow_damage=True), experiment["task"].get("robot")
    config, episode = find_episode(store, seed)
    if "recorded" in episode.draws:
        raise UserError(f"seed {seed} in {folder} was imported from a recording, so there is no world to replay it in")
    if not isinstance(config.get("task"), dict):
        raise UserError(f"{folder} does not contain the task of seed {seed}, so there is no scene to replay it in")
    if robot:
        config["task"]["robot"] = robot
    require_no_paths(config, ("task",), folder, ["task.robot"] if robot else [])
    environment = make_environment(config["task"])
    store.spec.require(environment.spec, f"the episode store {folder}", "its task as it is built now")
    with (
        closing(environment),
        recording(experiment, experiment.output / f"episode-{seed}.rrd") as (recorder, files),
        environment.blind(),
    ):
        step = replay(environment, episode, recorder).first_difference
    if step is None:
        log.info("the replay goes through the same states, bit for bit, and ends in %s", episode.outcome)
    else:
        log.warning("the replay differs from step %d on: a recording shows its scene, all else is from the store", step)
    if files:
        log.info("wrote %s", " and ".join(map(str, files)))
