"""`job=collect`: fill the episode store with verified demonstrations."""

from __future__ import annotations

import logging
from pathlib import Path

from vla.config.experiment import Experiment
from vla.data.episodes import EpisodeStore
from vla.data.formats.imported_demonstrations import ImportedDemonstrations
from vla.data.header import is_store
from vla.io.errors import UserError, counted
from vla.rollouts.collect import collect
from vla.spec import FIRST_SEED, Environment, Multitask, Spec, SpecOnly

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Fill the episode store."""
    demonstrations(experiment)


def demonstrations(experiment: Experiment) -> EpisodeStore:
    """Return the episode store of an experiment, limited to `collect.episodes`; collect missing episodes.

    Raises a UserError if the store has episodes of another experiment, or collection fails.
    """
    collection = experiment.collect
    if collection.seed + collection.episodes > FIRST_SEED:
        raise UserError(f"collect.seed + collect.episodes must be at most {FIRST_SEED}: later seeds are for evaluation")
    store = complete_store(experiment)
    if store is None:
        store = _fill(experiment)
    else:
        folder = experiment["expert"].get("folder")
        if folder and Path(folder).exists() and not store.is_derived and (recordings := _source(experiment)[2]):
            recordings.require_held(store)
        if store.is_derived:
            store.spec.require_input(experiment.world().spec, f"the episode store {store.folder}", "the task")
        if keys := [key for key, node in experiment.source.items() if store.lacks(key, node)]:
            log.warning("%s was derived from demonstrations with another %s", store.folder, " and another ".join(keys))
        log.info("%s: %s of %d, none new", store.folder, counted(collection.episodes, "episode"), len(store.episodes))
    return EpisodeStore(store.folder, collection.episodes)


def demonstration_spec(experiment: Experiment) -> Spec:
    """Return the spec of the demonstrations; a complete store contains it, otherwise the simulator is built."""
    store = complete_store(experiment)
    return store.spec if store else _source(experiment)[1]


def complete_store(experiment: Experiment) -> EpisodeStore | None:
    """Return the episode store of an experiment if it has enough episodes.

    Raises a UserError if the store has another task, expert, first seed, or loss of image compression.
    """
    collection = experiment.collect
    if not is_store(Path(collection.folder)):
        return None
    store = EpisodeStore(Path(collection.folder))
    store.require(experiment.source, collection.codec)
    store.require_first_seed(collection.seed)
    return store if len(store.episodes) >= collection.episodes else None


def _source(experiment: Experiment) -> tuple[Environment | SpecOnly, Spec, ImportedDemonstrations | None]:
    """Return the closed world, the spec of the demonstrations, and the recordings to import: None if an expert acts."""
    world = experiment.world()
    expert = experiment.build("expert", spec=world.spec)
    recordings = expert if isinstance(expert, ImportedDemonstrations) else None
    return world, recordings.spec if recordings else world.spec, recordings


def _fill(experiment: Experiment) -> EpisodeStore:
    collection, cluster = experiment.collect, experiment.build("cluster")
    world, spec, recordings = _source(experiment)
    if recordings is not None:
        recordings.require_enough(collection.episodes)
        if collection.seed:
            raise UserError(f"collect.seed={collection.seed}: recorded episodes are numbered from 0, so omit it")
    store = EpisodeStore.create_or_open(Path(collection.folder), spec, experiment.source, collection.codec)
    if recordings is not None:
        added = recordings.fill(store, collection.episodes)
        log.info("%s: %s, %d of them new", store.folder, counted(len(store.episodes), "recorded episode"), added)
        return store
    makers = experiment.make_environment(), experiment.make_expert()
    multitask = world if isinstance(world, Multitask) else None
    summary = collect(store, *makers, collection.episodes, cluster, collection.seed, multitask)
    if len(summary.tasks) > 1:
        for task, (successes, seeds) in summary.tasks.items():
            log.info("%s: %s of %s", task, counted(successes, "episode"), counted(seeds, "seed"))
    failures = ", ".join(f"{count} {cause}" for cause, count in summary.failures.items()) or "none"
    log.info(
        "%s: %s, %d of them new in %.0f s; expert success %.1f %%, failures: %s",
        *(store.folder, counted(summary.episodes, "episode"), summary.added, summary.seconds),
        *(100 * summary.success_rate, failures),
    )
    return store
