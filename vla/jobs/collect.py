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
    wanted = experiment.collect
    if wanted.seed + wanted.episodes > FIRST_SEED:
        raise UserError(f"collect.seed + collect.episodes must be at most {FIRST_SEED}: later seeds are for evaluation")
    store = complete_store(experiment)
    if store is None:
        store = _fill(experiment)
    else:
        folder = experiment["expert"].get("folder")
        if folder and Path(folder).exists() and not store.derived and (recorded := _source(experiment)[2]):
            recorded.require_held(store)
        if store.derived:
            store.spec.require_input(experiment.world().spec, f"the episode store {store.folder}", "the task")
        if others := [key for key, node in experiment.source.items() if store.lacks(key, node)]:
            log.warning(
                "%s was derived from demonstrations with another %s", store.folder, " and another ".join(others)
            )
        log.info("%s: %s of %d, none new", store.folder, counted(wanted.episodes, "episode"), len(store.episodes))
    return EpisodeStore(store.folder, wanted.episodes)


def demonstration_spec(experiment: Experiment) -> Spec:
    """Return the spec of the demonstrations; a complete store contains it, otherwise the simulator is built."""
    store = complete_store(experiment)
    return store.spec if store else _source(experiment)[1]


def complete_store(experiment: Experiment) -> EpisodeStore | None:
    """Return the episode store of an experiment if it has enough episodes.

    Raises a UserError if the store has another task, expert, first seed, or loss of image compression.
    """
    wanted = experiment.collect
    if not is_store(Path(wanted.folder)):
        return None
    store = EpisodeStore(Path(wanted.folder))
    store.require(experiment.source)
    store.require_codec(wanted.codec)
    store.require_first_seed(wanted.seed)
    return store if len(store.episodes) >= wanted.episodes else None


def _source(experiment: Experiment) -> tuple[Environment | SpecOnly, Spec, ImportedDemonstrations | None]:
    """Return the closed world, the spec of the demonstrations, and the recordings to import: None if an expert acts."""
    world = experiment.world()
    expert = experiment.build("expert", spec=world.spec)
    recorded = expert if isinstance(expert, ImportedDemonstrations) else None
    return world, recorded.spec if recorded else world.spec, recorded


def _fill(experiment: Experiment) -> EpisodeStore:
    wanted, cluster = experiment.collect, experiment.cluster()
    world, spec, recorded = _source(experiment)
    if recorded is not None:
        recorded.require_enough(wanted.episodes)
        if wanted.seed:
            raise UserError(f"collect.seed={wanted.seed}: recorded episodes are numbered from 0, so omit it")
    store = EpisodeStore.create_or_open(Path(wanted.folder), spec, experiment.source, wanted.codec)
    if recorded is not None:
        added = recorded.fill(store, wanted.episodes)
        log.info("%s: %s, %d of them new", store.folder, counted(len(store.episodes), "recorded episode"), added)
        return store
    makers = experiment.make_environment(), experiment.make_expert()
    multitask = world if isinstance(world, Multitask) else None
    summary = collect(store, *makers, wanted.episodes, cluster, wanted.seed, multitask)
    if len(summary.tasks) > 1:
        for task, (solved, tried) in summary.tasks.items():
            log.info("%s: %s of %s", task, counted(solved, "episode"), counted(tried, "seed"))
    failures = ", ".join(f"{count} {cause}" for cause, count in summary.failures.items()) or "none"
    log.info(
        "%s: %s, %d of them new in %.0f s; expert success %.1f %%, failures: %s",
        *(store.folder, counted(summary.episodes, "episode"), summary.added, summary.seconds),
        *(100 * summary.success_rate, failures),
    )
    return store
