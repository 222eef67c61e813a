"""What `job=inspect` does with episode stores: look into one, put one together from others, replay one episode."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

from rich import print as show

from vla.card import store_table, write_card
from vla.check import require_no_paths
from vla.data.episodes import EpisodeStore
from vla.data.index import listed
from vla.data.inspection import examine, find, put_together, require_whole

log = logging.getLogger(__name__)


def look_into(
    folder: str, stores: list[str] | None, where: dict[str, Any] | None, repair: bool, into: str | None
) -> None:
    """Verify and describe the store in `folder`, or the new one that is put together if the other arguments say so.

    Args: as in the node `inspect` of the config.

    Raises:
        ValueError: there is no such store, it cannot be made, or it is damaged; what is whole was described then.
    """
    findings = examine(EpisodeStore(_chosen(folder, stores, where, repair, into), damaged=True))
    show(store_table(findings))
    if findings.whole:
        log.info("wrote %s and card.png", write_card(findings))
    require_whole(findings)


def _chosen(
    folder: str, stores: list[str] | None, where: dict[str, Any] | None, repair: bool, into: str | None
) -> Path:
    """Path of the store to look into, which is there or is made."""
    if stores == []:
        raise ValueError("inspect.stores=[] names no store: leave it out, or give at least one folder")
    if into is None and (stores or where):
        raise ValueError("inspect.stores and inspect.where make a new store: say where, with inspect.into=DIR")
    if into is None and not repair:
        return Path(folder)
    sources = [EpisodeStore(source, damaged=repair) for source in stores or [folder]]
    if into is None and not examine(sources[0]).damaged:
        log.info("nothing in %s is damaged, so nothing is repaired", folder)
        return Path(folder)
    new = Path(f"{Path(folder)}-repaired" if into is None else into)
    damaged = put_together(sources, new, where, repair)
    log.info("put %s together; what it comes from is untouched", new)
    if damaged:
        log.warning("%d seeds were damaged and count as failed now: %s", len(damaged), listed(damaged))
    return new


def replay_into(output: Path, folder: Path, seed: int) -> None:
    """Write `episode-SEED.rrd`: a stored episode, in the scene that its task gives when its actions are executed again.

    Raises:
        ValueError: there is no such episode, or its store does not say in which task it was made.
    """
    from vla.parts import make_environment
    from vla.record import RerunRecorder, recording_name
    from vla.rollout import replay
    from vla.tasks.backend import choose_backend

    store = EpisodeStore(folder, damaged=True)
    config, episode = find(store, seed)
    if "task" not in config:
        raise ValueError(
            f"{folder} does not say in which task seed {seed} was made, so there is no scene to replay it in"
        )
    choose_backend()  # before the check imports MuJoCo, which reads MUJOCO_GL at once
    require_no_paths(config, ("task",), folder)
    environment = make_environment(config["task"])
    store.spec.require(environment.spec, f"the episode store {folder}", "its task as it is built now")
    with environment.blind():
        step = replay(environment, episode, RerunRecorder(output))
    environment.close()
    recording = output / f"episode-{seed}.rrd"
    os.replace(output / f"{recording_name(seed, episode.outcome)}.rrd", recording)
    if step is None:
        log.info("the replay goes through the same joint angles, bit for bit, and ends in %s", episode.outcome)
    else:
        log.warning("the replay differs from step %d on: the scene is the replay's, all else is from the store", step)
    log.info("wrote %s", recording)
