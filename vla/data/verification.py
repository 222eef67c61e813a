"""Verification of episode stores, and episodes read back from them.

Shapes: N steps, D action components.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vla.data.episodes import DamageError, EpisodeStore, observations_of
from vla.data.index import DAMAGED, LOST, MAX_LISTED, NOT_NEEDED, Entry, format_numbers
from vla.io.errors import UserError, counted
from vla.io.printable import track
from vla.spec import Array, Episode


@dataclass(frozen=True)
class StoreReport:
    """Result of the verification of a store."""

    store: EpisodeStore
    intact_entries: list[Entry]  # the undamaged episodes
    damaged_seeds: dict[str, list[int]]  # kind of damage → seeds
    actions: Array  # (N, D) float32, of the undamaged episodes

    @property
    def hours(self) -> float:
        """Robot time of the undamaged episodes [h]."""
        return len(self.actions) / self.store.spec.control_hz / 3600

    @property
    def outcomes(self) -> dict[str, int]:
        """Outcome → number of tried seeds, the most frequent first."""
        discarded_entries = [entry for entry in self.store.attempts if not entry.is_stored]
        counts = Counter(entry.outcome for entry in (*self.intact_entries, *discarded_entries))
        counts[DAMAGED] += sum(map(len, self.damaged_seeds.values()))
        successes = counts.pop("success", 0)
        failures = {cause: count for cause, count in counts.most_common() if count and cause not in (LOST, NOT_NEEDED)}
        return {"success": successes, **failures}

    @property
    def success_rate(self) -> float:
        """Share of the solved seeds among those of known outcome, 0…1."""
        total = sum(self.outcomes.values()) - self.outcomes.get(DAMAGED, 0)
        return self.outcomes["success"] / total if total else 0.0

    @property
    def sizes(self) -> dict[str, int]:
        """Field → bytes of the undamaged episodes."""
        return {name: sum(self.store.size(name, entry) for entry in self.intact_entries) for name in self.store.fields}


def verify_store(store: EpisodeStore) -> StoreReport:
    """Verify checksums, index lines and finite numbers of every episode of a store that may be damaged."""
    entries_by_config(store)  # raises an error if lines are missing
    seeds_by_damage: dict[str, list[int]] = {}
    whole_episodes, actions = [], []
    if lost_seeds := [entry.seed for entry in store.attempts if entry.outcome == LOST]:
        seeds_by_damage["no readable line in the index"] = lost_seeds
    for entry in track(store.episodes, description="verifying"):
        try:
            rows = _finite_rows(store, entry)
        except DamageError as damage:
            seeds_by_damage.setdefault(damage.damage, []).append(entry.seed)
            continue
        whole_episodes.append(entry)
        actions.append(rows["action"])
    no_actions = np.empty((0, len(store.spec.action)), np.float32)
    return StoreReport(store, whole_episodes, seeds_by_damage, np.concatenate([no_actions, *actions]))


def require_whole(report: StoreReport) -> None:
    """Raise a UserError if a store has damaged episodes or none."""
    folder, count = report.store.folder, sum(map(len, report.damaged_seeds.values()))
    if report.damaged_seeds:
        problems = [
            f"{counted(len(seeds), 'seed')}, {format_numbers(seeds)}: {kind}"
            for kind, seeds in report.damaged_seeds.items()
        ]
        rest = [f"and {counted(len(problems) - MAX_LISTED, 'other')}"] if len(problems) > MAX_LISTED else []
        summary = "; ".join([*problems[:MAX_LISTED], *rest])
        raise UserError(
            f"{folder} has {counted(count, 'damaged episode')} ({summary}): inspect.repair=true copies what is whole"
        )
    report.store.require_episodes()


def find_episode(store: EpisodeStore, seed: int) -> tuple[dict[str, Any], Episode]:
    """Return the config and the episode of a seed (UserError: the seed was not tried, failed or occurs twice, or its
    episode is damaged)."""
    pairs = [(config, entry) for config, entries in entries_by_config(store) for entry in entries if entry.seed == seed]
    stored_pairs = [(config, entry) for config, entry in pairs if entry.is_stored]
    if not pairs:
        seeds = format_numbers([entry.seed for entry in store.attempts]) or "none yet"
        raise UserError(f"{store.folder} has no seed {seed}: it holds {seeds}")
    if not stored_pairs:
        seeds, outcome = format_numbers([entry.seed for entry in store.episodes]) or "none", pairs[0][1].outcome
        raise UserError(
            f"seed {seed} in {store.folder} ended as {outcome}, and its steps were not kept; seeds with steps: {seeds}"
        )
    if len(stored_pairs) > 1:
        problem = f"{store.folder} has {len(stored_pairs)} episodes of seed {seed}"
        raise UserError(f"{problem}: inspect one of the stores that it was merged from")
    config, entry = stored_pairs[0]
    return config, episode_of(store, entry)


def episode_of(store: EpisodeStore, entry: Entry) -> Episode:
    """Read an episode back from a store; a DamageError if it is damaged."""
    rows = _finite_rows(store, entry)
    observations = observations_of(store.spec, rows, entry.instruction)
    return replace(without_rows(entry), observations=observations, actions=rows["action"], executed=rows["executed"])


def without_rows(entry: Entry) -> Episode:
    """Return the episode of an index entry, without its rows."""
    return Episode(
        entry.seed, entry.task, entry.instruction, entry.outcome, frozenset(entry.milestones), draws=entry.draws
    )


def _finite_rows(store: EpisodeStore, entry: Entry) -> dict[str, Array]:
    """Read an episode, whose numbers must be finite as well."""
    rows = store.read(entry)
    if not all(np.isfinite(values).all() for values in rows.values() if values.dtype.kind == "f"):
        damage = "numbers that are not finite"
        raise DamageError(f"seed {entry.seed} in {store.folder} has {damage}", damage)
    return rows


def entries_by_config(store: EpisodeStore) -> list[tuple[dict[str, Any], list[Entry]]]:
    """Return the entries of a store by their config; a UserError if the index of a derived store lost lines."""
    parts = store.config["parts"] if store.is_derived else [(store.config, len(store.attempts))]
    ends = np.cumsum([entries for _, entries in parts]).tolist()
    if ends[-1:] != [len(store.attempts)]:
        raise UserError(f"the index of {store.folder} has lost lines: derive it again from its sources")
    return [(config, store.attempts[end - entries : end]) for (config, entries), end in zip(parts, ends, strict=True)]
