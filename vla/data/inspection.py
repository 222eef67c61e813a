"""Episode stores looked into, episode by episode, and put together anew from what is whole, chosen, or in several.

Nothing is changed in place: a new store is written beside its name and takes it when it is complete.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from vla.data.episodes import EpisodeStore, stored
from vla.data.index import DAMAGED, LOST, Entry, listed
from vla.data.selection import Selection
from vla.spec import Array, Episode, Observation

# N steps, D action components

Found = tuple[EpisodeStore, Entry]


class DamageError(ValueError):
    """An episode is not what was written."""


@dataclass(frozen=True)
class Findings:
    """What is in a store."""

    store: EpisodeStore
    whole: list[Entry]  # the episodes that can be used
    damaged: dict[str, list[int]]  # what is wrong → seeds of which it is true
    actions: Array  # (N, D) float32, of the whole episodes
    executed: Array  # (N, D) float32

    @property
    def hours(self) -> float:
        """Time that the whole episodes took the robot [h]."""
        return len(self.actions) / self.store.spec.control_hz / 3600

    @property
    def outcomes(self) -> dict[str, int]:
        """Outcome → seeds that were tried, the most frequent first."""
        failures = Counter(entry.outcome for entry in self.store.tried if not entry.success and entry.outcome != LOST)
        failures[DAMAGED] += sum(map(len, self.damaged.values()))
        return {"success": len(self.whole), **{cause: count for cause, count in failures.most_common() if count}}

    @property
    def success_rate(self) -> float:
        """Share of the seeds that were solved, 0…1, apart from those of which nothing is known."""
        known = sum(self.outcomes.values()) - self.outcomes.get(DAMAGED, 0)
        return len(self.whole) / known if known else 0.0

    @property
    def sizes(self) -> dict[str, int]:
        """Field → bytes of the whole episodes."""
        fields = {name: self.store.rows(name) for name in self.store.fields}
        spans = [slice(entry.start, entry.start + entry.steps) for entry in self.whole]
        return {name: sum(stored(rows, span).nbytes for span in spans) for name, rows in fields.items()}


def examine(store: EpisodeStore) -> Findings:
    """Read every episode of a store, which may be damaged: checksums, index, finite numbers, seeds."""
    damaged: dict[str, list[int]] = {}
    whole, actions, executed = [], [], []
    if lost := [entry.seed for entry in store.tried if entry.outcome == LOST]:
        damaged["no readable line in the index"] = lost
    if twice := _repeated_seeds(store):
        damaged["in the index more than once"] = twice
    for entry in track(store.episodes, description="verifying"):
        rows, problem = _rows_of(store, entry)
        if problem:
            damaged.setdefault(problem, []).append(entry.seed)
        else:
            whole.append(entry)
            actions.append(rows["action"])
            executed.append(rows["executed"])
    none = np.empty((0, len(store.spec.action)), np.float32)
    return Findings(store, whole, damaged, np.concatenate([none, *actions]), np.concatenate([none, *executed]))


def require_whole(findings: Findings) -> None:
    """Raise a ValueError that names what is damaged in a store, or says that it is empty, and the way out."""
    folder, count = findings.store.folder, sum(map(len, findings.damaged.values()))
    if findings.damaged:
        told = "; ".join(f"seeds {listed(seeds)}: {problem}" for problem, seeds in findings.damaged.items())
        raise ValueError(
            f"{folder} has {count} damaged episodes ({told}): inspect.repair=true leaves them out of a copy"
        )
    if not findings.whole:
        raise ValueError(f"{folder} holds no episodes yet: collect some first")


def find(store: EpisodeStore, seed: int) -> tuple[dict[str, Any], Episode]:
    """The episode of a seed, and the config of which it was made.

    Raises:
        ValueError: the seed was never tried, failed, stands there twice, or its episode is damaged.
    """
    found = [(config, entry) for config, entries in parts_of(store) for entry in entries if entry.seed == seed]
    if not found:
        seeds = [entry.seed for entry in store.tried]
        raise ValueError(f"{store.folder} has no seed {seed}: it holds {listed(seeds) or 'none yet'}")
    stored = [(config, entry) for config, entry in found if entry.success]
    if not stored:
        seeds = sorted({entry.seed for entry in store.episodes}, key=lambda other: abs(other - seed))[:2]
        raise ValueError(
            f"seed {seed} in {store.folder} ended as {found[0][1].outcome}, and only successes are kept: there is "
            f"{' or '.join(map(str, seeds)) or 'none'}"
        )
    if len(stored) > 1:
        raise ValueError(
            f"{store.folder} has {len(stored)} episodes of seed {seed}: ask one of the stores it is made of"
        )
    return stored[0][0], episode_of(store, stored[0][1])


def episode_of(store: EpisodeStore, entry: Entry) -> Episode:
    """An episode as it was before it was stored; a DamageError says that it no longer is."""
    rows, problem = _rows_of(store, entry)
    if problem:
        raise DamageError(
            f"seed {entry.seed} in {store.folder} is damaged ({problem}): inspect.repair=true leaves it out of a copy"
        )
    names, sizes = [name for name, _ in store.spec.truth], [size for _, size in store.spec.truth]
    observations = []
    for step in range(entry.steps):
        truth = np.split(rows["truth"][step], np.cumsum(sizes)[:-1]) if names else None
        observations.append(
            Observation(
                rgb={camera: rows[f"rgb_{camera}"][step] for camera in store.spec.cameras},
                depth={camera: rows[f"depth_{camera}"][step] for camera in store.spec.cameras},
                joints=rows["joints"][step],
                velocities=rows["velocities"][step],
                gripper=float(rows["gripper"][step, 0]),
                instruction=entry.instruction,
                truth=None if truth is None else dict(zip(names, truth, strict=True)),
            )
        )
    what = (entry.seed, entry.instruction, entry.outcome, entry.draws)
    return Episode(*what, observations, actions=rows["action"], executed=rows["executed"])


def parts_of(store: EpisodeStore) -> list[tuple[dict[str, Any], list[Entry]]]:
    """The entries of a store by the config that they were made of; a ValueError if there is no telling."""
    if not store.derived:
        return [(store.config, store.tried)]
    ends = np.cumsum([0, *(part["entries"] for part in store.config["parts"])])
    if ends[-1] != len(store.tried):
        raise ValueError(f"the index of {store.folder} has lost lines: put it together again, from where it came from")
    return [(part["config"], store.tried[ends[at] : ends[at + 1]]) for at, part in enumerate(store.config["parts"])]


def put_together(
    stores: Sequence[EpisodeStore], folder: Path, where: Mapping[str, Any] | None = None, repair: bool = False
) -> list[int]:
    """Write a new store of what fits `where` in others of the same spec; all of it or nothing.

    Seeds come in order, config by config. Of the same seed of the same config one whole episode is kept. Where all
    seeds between the first and the last of one config are there, the new store is as if collected, and may grow.
    Returns the seeds that were damaged everywhere.

    Args:
        stores: where the episodes are; with `repair` they may be damaged.
        folder: of the new store; it does not exist yet.
        where: conditions, see `vla.data.selection`.
        repair: a damaged episode becomes a failed seed, instead of ending it all.

    Raises:
        ValueError: the folder exists, specs differ, nothing fits, or an episode is damaged.
    """
    if folder.exists():
        raise ValueError(f"{folder} exists already and is left alone: choose another inspect.into")
    for store in stores[1:]:
        store.spec.require(stores[0].spec, f"the episode store {store.folder}", f"{stores[0].folder}")
    chosen = _choose(stores, where or {})
    episodes = sum(any(entry.success for _, entry in found) for seeds in chosen.values() for found in seeds.values())
    if not episodes:
        fitting = f" that fit inspect.where={dict(where)}" if where else ""
        raise ValueError(f"{', '.join(str(store.folder) for store in stores)}: there are no episodes{fitting}")
    draft = folder.with_name(f".{folder.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)  # left by a process that was killed
    try:
        store = EpisodeStore.create_or_open(draft, stores[0].spec, _config(chosen, stores, where))
        with store.writing():
            seeds = [(seed, found) for part in chosen.values() for seed, found in sorted(part.items())]
            damaged = [seed for seed, found in track(seeds, "writing") if not _write(store, seed, found, repair)]
        os.rename(draft, folder)
    except BaseException as error:
        shutil.rmtree(draft, ignore_errors=True)
        if isinstance(error.__cause__, OSError):  # of a store that grows, of which more would be left
            raise ValueError(
                f"{folder} cannot be written ({error.__cause__.strerror}), nothing of it is kept: make room there, or "
                "choose another inspect.into"
            ) from error
        raise
    return damaged


Chosen = dict[str, dict[int, list[Found]]]  # config as JSON → seed → where it is to be found


def _choose(stores: Sequence[EpisodeStore], where: Mapping[str, Any]) -> Chosen:
    fits = Selection(where, [entry for store in stores for entry in store.tried])
    chosen: Chosen = {}
    for store in stores:
        for config, entries in parts_of(store):
            seeds = chosen.setdefault(json.dumps(config), {})
            for entry in filter(fits, entries):
                seeds.setdefault(entry.seed, []).append((store, entry))
    return {config: seeds for config, seeds in chosen.items() if seeds}


def _config(chosen: Chosen, stores: Sequence[EpisodeStore], where: Mapping[str, Any] | None) -> dict[str, Any]:
    conditions = [condition for store in stores if store.derived for condition in store.config["where"]]
    conditions += [dict(where)] if where else []
    (config, seeds), *others = chosen.items()
    exact = not any(store.lossy(field) for store in stores for field in store.fields)
    if not others and not conditions and exact and max(seeds) - min(seeds) == len(seeds) - 1:
        collected: dict[str, Any] = json.loads(config)
        return collected
    parts = [{"config": json.loads(config), "entries": len(seeds)} for config, seeds in chosen.items()]
    return {"parts": parts, "where": conditions}


def _write(store: EpisodeStore, seed: int, found: Sequence[Found], repair: bool) -> bool:
    """Add a seed to a store, from the first place where it is whole; whether there was one."""
    draws: dict[str, Any] = {}
    for source, entry in sorted(found, key=lambda place: not place[1].success):
        if entry.outcome == LOST:
            continue
        draws = entry.draws
        if not entry.success:
            store.fail(seed, entry.outcome, draws)
            return True
        try:
            store.append(episode_of(source, entry))
            return True
        except DamageError:
            if not repair:
                raise
    store.fail(seed, DAMAGED, draws)
    return False


def _rows_of(store: EpisodeStore, entry: Entry) -> tuple[dict[str, Array], str]:
    """The rows of an episode and what is wrong with them, if anything is."""
    try:
        rows = store.read(entry) if entry.steps else {}
    except ValueError:
        rows = {}
    if not rows:
        return rows, "rows changed or lost"
    if not all(np.isfinite(values).all() for values in rows.values() if values.dtype.kind == "f"):
        return rows, "numbers that are not finite"
    return rows, ""


def _repeated_seeds(store: EpisodeStore) -> list[int]:
    counts = [Counter(entry.seed for entry in entries) for _, entries in parts_of(store)]
    return sorted({seed for part in counts for seed, count in part.items() if count > 1})
