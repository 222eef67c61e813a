"""Verification of episode stores, and derivation of new ones by repair, filtering and merging.

Nothing is changed in place: a new store is written to a temporary folder and renamed when it is complete.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from vla.data.episode_filter import episode_filter
from vla.data.episodes import DamageError, EpisodeStore, observations_of
from vla.data.header import Codec
from vla.data.index import DAMAGED, LISTED, LOST, NOT_NEEDED, Entry, listed
from vla.io.errors import UserError
from vla.spec import Array, Episode

# N steps, D action components

Copy = tuple[EpisodeStore, Entry]


@dataclass(frozen=True)
class StoreReport:
    """Result of the verification of a store."""

    store: EpisodeStore
    whole: list[Entry]  # the undamaged episodes
    damaged: dict[str, list[int]]  # kind of damage → seeds
    actions: Array  # (N, D) float32, of the undamaged episodes
    executed: Array  # (N, D) float32

    @property
    def hours(self) -> float:
        """Robot time of the undamaged episodes [h]."""
        return len(self.actions) / self.store.spec.control_hz / 3600

    @property
    def outcomes(self) -> dict[str, int]:
        """Outcome → number of tried seeds, the most frequent first."""
        discarded = [entry for entry in self.store.tried if not entry.stored]
        known = Counter(entry.outcome for entry in (*self.whole, *discarded))
        known[DAMAGED] += sum(map(len, self.damaged.values()))
        solved = known.pop("success", 0)
        failures = {cause: count for cause, count in known.most_common() if count and cause not in (LOST, NOT_NEEDED)}
        return {"success": solved, **failures}

    @property
    def success_rate(self) -> float:
        """Share of the solved seeds among those of known outcome, 0…1."""
        known = sum(self.outcomes.values()) - self.outcomes.get(DAMAGED, 0)
        return self.outcomes["success"] / known if known else 0.0

    @property
    def sizes(self) -> dict[str, int]:
        """Field → bytes of the undamaged episodes."""
        return {name: sum(self.store.size(name, entry) for entry in self.whole) for name in self.store.fields}


def verify_store(store: EpisodeStore) -> StoreReport:
    """Verify checksums, index, finite numbers and seeds of every episode of a store that may be damaged."""
    damaged: dict[str, list[int]] = {}
    whole, actions, executed = [], [], []
    if lost := [entry.seed for entry in store.tried if entry.outcome == LOST]:
        damaged["no readable line in the index"] = lost
    if twice := _repeated_seeds(store):
        damaged["in the index more than once"] = twice
    for entry in track(store.episodes, description="verifying"):
        try:
            rows = _rows_of(store, entry)
        except DamageError as damage:
            damaged.setdefault(damage.what, []).append(entry.seed)
            continue
        whole.append(entry)
        actions.append(rows["action"])
        executed.append(rows["executed"])
    none = np.empty((0, len(store.spec.action)), np.float32)
    return StoreReport(store, whole, damaged, np.concatenate([none, *actions]), np.concatenate([none, *executed]))


def require_whole(report: StoreReport) -> None:
    """Raise a UserError if a store has damaged episodes or none."""
    folder, count = report.store.folder, sum(map(len, report.damaged.values()))
    if report.damaged:
        problems = [f"seeds {listed(seeds)}: {problem}" for problem, seeds in report.damaged.items()]
        more = [f"and {len(problems) - LISTED} others"] if len(problems) > LISTED else []
        named = "; ".join([*problems[:LISTED], *more])
        raise UserError(
            f"{folder} has {count} damaged episodes ({named}): inspect.repair=true leaves them out of a copy"
        )
    report.store.require_episodes()


def find_episode(store: EpisodeStore, seed: int) -> tuple[dict[str, Any], Episode]:
    """Return the config and the episode of a seed.

    Raises:
        UserError: the seed was not tried, failed or occurs twice, or its episode is damaged.
    """
    found = [(config, entry) for config, entries in entries_by_config(store) for entry in entries if entry.seed == seed]
    if not found:
        seeds = [entry.seed for entry in store.tried]
        raise UserError(f"{store.folder} has no seed {seed}: it holds {listed(seeds) or 'none yet'}")
    kept = [(config, entry) for config, entry in found if entry.stored]
    if not kept:
        seeds = sorted({entry.seed for entry in store.episodes}, key=lambda other: abs(other - seed))[:2]
        raise UserError(
            f"seed {seed} in {store.folder} ended as {found[0][1].outcome}, and its steps were not kept: there is "
            f"{' or '.join(map(str, seeds)) or 'none'}"
        )
    if len(kept) > 1:
        raise UserError(
            f"{store.folder} has {len(kept)} episodes of seed {seed}: inspect one of the stores that it was merged from"
        )
    return kept[0][0], episode_of(store, kept[0][1])


def episode_of(store: EpisodeStore, entry: Entry) -> Episode:
    """Read an episode back from a store; a DamageError if it is damaged."""
    rows = _rows_of(store, entry)
    observations = observations_of(store.spec, rows, entry.instruction)
    return replace(_without_rows(entry), observations=observations, actions=rows["action"], executed=rows["executed"])


def _without_rows(entry: Entry) -> Episode:
    """Return the episode of an index entry, without its rows."""
    what = (entry.seed, entry.task, entry.instruction, entry.outcome, frozenset(entry.milestones), entry.draws)
    return Episode(*what, observations=[], actions=np.empty((0, 0)), executed=np.empty((0, 0)))


def entries_by_config(store: EpisodeStore) -> list[tuple[dict[str, Any], list[Entry]]]:
    """Return the entries of a store by their config; a UserError if the index of a derived store lost lines."""
    if not store.derived:
        return [(store.config, store.tried)]
    ends = np.cumsum([0, *(part["entries"] for part in store.config["parts"])])
    if ends[-1] != len(store.tried):
        raise UserError(f"the index of {store.folder} has lost lines: derive it again from its sources")
    return [(part["config"], store.tried[ends[at] : ends[at + 1]]) for at, part in enumerate(store.config["parts"])]


def derive_store(
    stores: Sequence[EpisodeStore], folder: Path, where: Mapping[str, Any] | None = None, repair: bool = False
) -> list[int]:
    """Write a new store of the episodes in others of the same spec that match `where`, atomically.

    Seeds are in order, config by config. Of the same seed and config one undamaged episode is kept. If all seeds
    between the first and the last of a single config exist, the new store equals a collected one, and can grow.
    Returns the seeds that are damaged in every store.

    Args:
        stores: sources of the episodes; with `repair` they may be damaged.
        folder: of the new store; it must not exist.
        where: conditions, see `vla.data.episode_filter`.
        repair: turn a damaged episode into a failed seed instead of raising.

    Raises:
        UserError: the folder exists, specs differ, nothing matches, or an episode is damaged.
    """
    if folder.exists():
        raise UserError(f"{folder} exists already and is left alone: choose another inspect.into")
    for store in stores[1:]:
        store.spec.require(stores[0].spec, f"the episode store {store.folder}", f"{stores[0].folder}")
    chosen = _choose(stores, where or {})
    episodes = sum(any(entry.stored for _, entry in found) for seeds in chosen.values() for found in seeds.values())
    if not episodes:
        fitting = f" that fit inspect.where={dict(where)}" if where else ""
        raise UserError(f"{', '.join(str(store.folder) for store in stores)}: there are no episodes{fitting}")
    draft = folder.with_name(f".{folder.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)  # left by a process that was killed
    try:
        config, codecs = _config(chosen, stores, where), {store.codec for store in stores}
        codec = Codec("lossless") if len(codecs) > 1 else codecs.pop()  # nothing more is lost
        store = EpisodeStore.create_or_open(draft, stores[0].spec, config, codec)
        with store.writing():
            seeds = [(seed, found) for part in chosen.values() for seed, found in sorted(part.items())]
            damaged = [seed for seed, found in track(seeds, "writing") if not _write(store, found, repair)]
        os.rename(draft, folder)
    except BaseException as error:
        shutil.rmtree(draft, ignore_errors=True)
        if isinstance(error.__cause__, OSError):  # of a growing store, whose message does not apply here
            raise UserError(
                f"{folder} cannot be written ({error.__cause__.strerror}), nothing of it is kept: make room there, or "
                "choose another inspect.into"
            ) from error
        raise
    return damaged


Chosen = dict[str, dict[int, list[Copy]]]  # config as JSON → seed → its copies


def _choose(stores: Sequence[EpisodeStore], where: Mapping[str, Any]) -> Chosen:
    matches = episode_filter(where, [entry for store in stores for entry in store.tried])
    chosen: Chosen = {}
    for store in stores:
        for config, entries in entries_by_config(store):
            seeds = chosen.setdefault(json.dumps(config), {})
            for entry in filter(matches, entries):
                seeds.setdefault(entry.seed, []).append((store, entry))
    return {config: seeds for config, seeds in chosen.items() if seeds}


def _config(chosen: Chosen, stores: Sequence[EpisodeStore], where: Mapping[str, Any] | None) -> dict[str, Any]:
    conditions = [condition for store in stores if store.derived for condition in store.config["where"]]
    conditions += [dict(where)] if where else []
    (config, seeds), *others = chosen.items()
    alike = len({store.codec.loss for store in stores}) == 1
    if not others and not conditions and alike and max(seeds) - min(seeds) == len(seeds) - 1:
        return json.loads(config)
    parts = [{"config": json.loads(config), "entries": len(seeds)} for config, seeds in chosen.items()]
    return {"parts": parts, "where": conditions}


def _write(store: EpisodeStore, copies: Sequence[Copy], repair: bool) -> bool:
    """Add a seed to a store from its first undamaged copy; returns whether there was one."""
    known = copies[0][1]
    for source, entry in sorted(copies, key=lambda copy: not copy[1].stored):
        if entry.outcome == LOST:
            continue
        known = entry
        if not entry.stored:
            store.fail(_without_rows(entry))
            return True
        try:
            store.append(episode_of(source, entry), source.packed(entry) if source.codec == store.codec else None)
            return True
        except DamageError:
            if not repair:
                raise
    store.fail(replace(_without_rows(known), outcome=DAMAGED))
    return False


def _rows_of(store: EpisodeStore, entry: Entry) -> dict[str, Array]:
    """Read an episode, whose numbers must be finite as well."""
    rows = store.read(entry)
    if not all(np.isfinite(values).all() for values in rows.values() if values.dtype.kind == "f"):
        what = "numbers that are not finite"
        raise DamageError(f"seed {entry.seed} in {store.folder} has {what}", what)
    return rows


def _repeated_seeds(store: EpisodeStore) -> list[int]:
    counts = [Counter(entry.seed for entry in entries) for _, entries in entries_by_config(store)]
    return sorted({seed for part in counts for seed, count in part.items() if count > 1})
