"""Many rollouts of the expert into an episode store: in parallel, verified, the same whatever the number of workers.

Seeds are tried in order and committed in order, until the store holds as many successes as were asked for.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vla.cluster import Cluster, Team, Wait
from vla.data.episodes import EpisodeStore
from vla.data.index import DAMAGED
from vla.files import atomic_path
from vla.rollout import replay, rollout
from vla.spec import FIRST_SEED, Agent, Environment, Episode
from vla.workers import MakeWorker, WorkersLost

log = logging.getLogger(__name__)

EFFORT = "seconds.txt"  # in the folder of a store: how long all collecting into it took [s]
PATIENCE = 50  # seeds that may fail in a row before the expert counts as hopeless
LOOK_AHEAD = 4  # episodes under way per worker: a long one must not keep the others waiting
NOT_REPEATABLE = "not_repeatable"  # outcome of a success that its own actions do not bring about again


class RepeatableEnvironment(Environment, Protocol):
    """An environment that can run without looking, which makes a replay cheap."""

    def blind(self) -> AbstractContextManager[None]:
        """Within this context observations carry no images."""
        ...

    def close(self) -> None:
        """Free what the environment holds."""
        ...


MakeEnvironment = Callable[[], RepeatableEnvironment]
MakeExpert = Callable[[RepeatableEnvironment], Agent]


@dataclass(frozen=True)
class Summary:
    """What a store holds, and what it took."""

    episodes: int  # successes stored
    added: int  # of which were added now
    tried: int  # seeds whose outcome is known: an episode that a repair gave up says nothing about the expert
    failures: dict[str, int]  # outcome → seeds
    seconds: float  # of this call

    @property
    def success_rate(self) -> float:
        """Share of the seeds tried that the expert solved, 0…1."""
        return self.episodes / self.tried if self.tried else 0.0


def collect(
    store: EpisodeStore,
    make_environment: MakeEnvironment,
    make_expert: MakeExpert,
    episodes: int,
    cluster: Cluster,
    seed: int,
) -> Summary:
    """Roll the expert out on `seed`, `seed` + 1, … until the store holds `episodes` successes.

    What is there already stays and is not made again. Another process that is collecting into the same store is waited
    for. Each process of `cluster` calls the two factories once.

    Raises:
        ValueError: the store starts at another seed or was not collected, the expert is hopeless, workers died, or the
            disk is full.
    """
    started = time.monotonic()
    before = len(store.episodes)
    if before < episodes and store.derived:
        raise ValueError(
            f"{store.folder} was put together from other stores and does not grow: set collect.episodes={before}"
        )
    _require_first_seed(store, seed)
    if before < episodes:
        with store.writing():
            before = len(store.episodes)  # another process may have added some while this one waited
            _require_first_seed(store, seed)
            if before < episodes:
                began = time.monotonic()  # and not when the wait for another process did
                try:
                    _fill_with(cluster, partial(Demonstrator, make_environment, make_expert), store, episodes, seed)
                finally:
                    _note_effort(store.folder, time.monotonic() - began)
    stored = len(store.episodes)
    failures = Counter(entry.outcome for entry in store.tried if not entry.success)
    tried = len(store.tried) - failures.pop(DAMAGED, 0)
    return Summary(stored, stored - before, tried, dict(failures), time.monotonic() - started)


def effort(store: EpisodeStore, episodes: int) -> float | None:
    """How long it took to collect so many of a store's episodes [s], whoever did; None if they came from elsewhere.

    What a process did that was killed outright does not count.
    """
    file = store.folder / EFFORT
    if not file.exists():
        return None
    return float(file.read_text(encoding="utf-8")) * episodes / len(EpisodeStore(store.folder).episodes)


def _note_effort(folder: Path, seconds: float) -> None:
    """Add to what is noted; on a full disk, of which the store complains, it stays as it is."""
    file = folder / EFFORT
    with suppress(OSError), atomic_path(file) as draft:
        before = float(file.read_text(encoding="utf-8")) if file.exists() else 0.0
        draft.write_text(f"{before + seconds:.1f}\n", encoding="utf-8")


def _require_first_seed(store: EpisodeStore, seed: int) -> None:
    if store.tried and not store.derived and store.tried[0].seed != seed:
        first = store.tried[0].seed
        raise ValueError(f"{store.folder} starts at seed {first}, not {seed}: set collect.seed={first}")


def _fill_with(cluster: Cluster, make: MakeWorker, store: EpisodeStore, episodes: int, seed: int) -> None:
    """Fill the store, with new workers if some died: in long collections a process was seen to crash outside Python."""
    while True:
        tried = len(store.tried)
        try:
            with cluster.team(make) as team:
                return _fill(store, team, episodes, seed)
        except WorkersLost:
            if len(store.tried) == tried:
                raise
            log.warning("workers were lost after %d episodes; going on with new ones", len(store.episodes))


def _fill(store: EpisodeStore, team: Team, episodes: int, seed: int) -> None:
    stored = before = len(store.episodes)
    next_seed = seed if store.next_seed is None else store.next_seed
    damaged = sum(entry.outcome == DAMAGED for entry in store.tried)
    in_a_row = 0  # failures
    started = time.monotonic()
    pending: deque[Wait] = deque()
    columns = (TextColumn("collecting"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
    with Progress(*columns, TimeRemainingColumn()) as progress:
        task = progress.add_task("", total=episodes, completed=stored)
        while stored < episodes:
            # Never more under way than are missing: an expert that does not fail makes none in vain.
            while len(pending) < min(LOOK_AHEAD * team.size, episodes - stored):
                if next_seed >= FIRST_SEED:
                    raise ValueError(f"seeds from {FIRST_SEED} on are kept for evaluation: lower collect.seed")
                pending.append(team.submit(next_seed))
                next_seed += 1
            episode: Episode = pending.popleft()()
            if episode.success:
                store.append(episode)
                stored, in_a_row = stored + 1, 0
            else:
                store.fail(episode.seed, episode.outcome, episode.draws)
                in_a_row += 1
                _give_up_after(store, in_a_row)
            speed = (stored - before) / (time.monotonic() - started)
            note = f"{speed:.1f} episodes/s, expert {stored / (len(store.tried) - damaged):.0%}"
            progress.update(task, completed=stored, description=note)


def _give_up_after(store: EpisodeStore, in_a_row: int) -> None:
    if in_a_row >= PATIENCE:
        causes = dict(Counter(entry.outcome for entry in store.tried[-in_a_row:]))
        raise ValueError(
            f"the expert failed on {in_a_row} seeds in a row ({causes}): watch it with job=preview, or ease the task"
        )


class Demonstrator:
    """One environment and one expert."""

    def __init__(self, make_environment: MakeEnvironment, make_expert: MakeExpert) -> None:
        self._environment = make_environment()
        self._expert = make_expert(self._environment)

    def attempt(self, seed: int) -> Episode:
        """Roll out one seed and, if that succeeds, replay it; only a success keeps its observations."""
        episode = rollout(self._environment, self._expert, seed)
        if episode.success and not _repeats(self._environment, episode):
            episode.outcome = NOT_REPEATABLE
        return episode if episode.success else replace(episode, observations=[])

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()


def _repeats(environment: RepeatableEnvironment, episode: Episode) -> bool:
    """Whether the executed actions lead from the seed to success again, through the same joint angles bit for bit."""
    with environment.blind():
        return replay(environment, episode) is None
