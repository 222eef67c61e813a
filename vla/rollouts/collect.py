"""Collection of expert episodes into a store: parallel, verified, independent of the number of workers.

Seeds are tried and committed in order, until the store holds the requested number of successes.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, cast

from annotated_types import Ge, Le
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vla.data.episodes import EpisodeStore
from vla.data.index import DAMAGED
from vla.io.documents import read_json
from vla.io.files import write_text
from vla.parallel.pool import Cluster, Future, Pool, WorkersLost
from vla.parallel.processes import WorkerFactory
from vla.rollouts.rollout import replay, rollout
from vla.spec import FIRST_SEED, Agent, Environment, Episode

log = logging.getLogger(__name__)

COLLECTION_TIME = "seconds.txt"  # file in a store: total duration of its collection [s]
Seconds = Annotated[float, Ge(0), Le(1e9)]
PATIENCE = 50  # consecutive failures at a task before collection is given up
LOOK_AHEAD = 4  # pending episodes per worker: a long one must not block the others
NOT_REPEATABLE = "not_repeatable"  # outcome of a success that the replay of its actions does not reproduce

EnvironmentFactory = Callable[[], Environment]
ExpertFactory = Callable[[Environment], Agent]


@dataclass(frozen=True)
class Summary:
    """Result of a collection."""

    episodes: int  # successes stored
    added: int  # of these, added by this call
    tried: int  # seeds of known outcome, that is, without the episodes lost in a repair
    failures: dict[str, int]  # outcome → seeds
    tasks: dict[str, tuple[int, int]]  # task → successes, seeds tried
    seconds: float  # of this call

    @property
    def success_rate(self) -> float:
        """Share of the tried seeds that the expert solved, 0…1."""
        return self.episodes / self.tried if self.tried else 0.0


def collect(
    store: EpisodeStore,
    make_environment: EnvironmentFactory,
    make_expert: ExpertFactory,
    episodes: int,
    cluster: Cluster,
    seed: int,
) -> Summary:
    """Roll the expert out on `seed`, `seed` + 1, … until the store holds `episodes` successes.

    Existing episodes are kept. If another process is collecting into the same store, wait for it. Each process of
    `cluster` calls the two factories once.

    Raises:
        ValueError: the store starts at another seed or is derived, the expert fails persistently, workers died, or the
            disk is full.
    """
    started = time.monotonic()
    before = len(store.episodes)
    if before < episodes and store.derived:
        raise ValueError(f"{store.folder} was derived from other stores and cannot grow: set collect.episodes={before}")
    _require_first_seed(store, seed)
    if before < episodes:
        with store.writing():
            before = len(store.episodes)  # another process may have added some meanwhile
            _require_first_seed(store, seed)
            if before < episodes:
                began = time.monotonic()  # excludes the wait for another process
                try:
                    _fill_with(
                        cluster, partial(DemonstrationWorker, make_environment, make_expert), store, episodes, seed
                    )
                finally:
                    _save_collection_time(store.folder, time.monotonic() - began)
    stored = len(store.episodes)
    tried = [entry for entry in store.tried if entry.outcome != DAMAGED]
    failures = Counter(entry.outcome for entry in tried if not entry.success)
    solved, asked = (Counter(entry.task for entry in entries) for entries in (store.episodes, tried))
    tasks = {task: (solved[task], asked[task]) for task in sorted(asked)}
    return Summary(stored, stored - before, len(tried), dict(failures), tasks, time.monotonic() - started)


def collection_time(store: EpisodeStore, episodes: int) -> float | None:
    """Return the time that it took to collect `episodes` of a store [s]; None if it is unknown.

    The time of killed processes is not included.
    """
    seconds = _saved_time(store.folder / COLLECTION_TIME)
    return seconds and seconds * episodes / len(EpisodeStore(store.folder).episodes)


def _saved_time(file: Path) -> float | None:
    """Return the duration in a file [s]; None, with a warning, for a damaged file: it only informs."""
    try:
        return read_json(file, cast(type[float], Seconds), largest=100) if file.exists() else None
    except (OSError, ValueError) as error:
        log.warning("the duration of the collection is unknown: %s", error)
        return None


def _save_collection_time(folder: Path, seconds: float) -> None:
    """Add to the saved time, unless that is unknown; ignored on a full disk, which the store reports."""
    file = folder / COLLECTION_TIME
    before = _saved_time(file) if file.exists() else 0.0
    if before is not None:
        with suppress(OSError):
            write_text(file, f"{before + seconds:.1f}\n")


def _require_first_seed(store: EpisodeStore, seed: int) -> None:
    if store.tried and not store.derived and store.tried[0].seed != seed:
        first = store.tried[0].seed
        raise ValueError(f"{store.folder} starts at seed {first}, not {seed}: set collect.seed={first}")


def _fill_with(cluster: Cluster, make: WorkerFactory, store: EpisodeStore, episodes: int, seed: int) -> None:
    """Fill the store, restarting workers that died: in long collections processes occasionally crash outside Python."""
    while True:
        tried = len(store.tried)
        try:
            with cluster.pool(make) as pool:
                return _fill(store, pool, episodes, seed)
        except WorkersLost as lost:
            if len(store.tried) == tried:
                raise WorkersLost(f"{lost}; committed episodes are safe, run again to continue") from lost
            log.warning("workers were lost after %d episodes; continuing with new ones", len(store.episodes))


def _fill(store: EpisodeStore, pool: Pool, episodes: int, seed: int) -> None:
    stored = before = len(store.episodes)
    next_seed = seed if store.next_seed is None else store.next_seed
    damaged = sum(entry.outcome == DAMAGED for entry in store.tried)
    in_a_row: dict[str, list[str]] = {}  # task → outcomes of the failures since its last success
    started = time.monotonic()
    pending: deque[Future] = deque()
    columns = (TextColumn("collecting"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
    with Progress(*columns, TimeRemainingColumn()) as progress:
        task = progress.add_task("", total=episodes, completed=stored)
        while stored < episodes:
            # No more pending than missing: without failures no episode is wasted.
            while len(pending) < min(LOOK_AHEAD * pool.size, episodes - stored):
                if next_seed >= FIRST_SEED:
                    raise ValueError(f"seeds from {FIRST_SEED} on are kept for evaluation: lower collect.seed")
                pending.append(pool.submit(next_seed))
                next_seed += 1
            episode: Episode = pending.popleft().result()
            if episode.success:
                store.append(episode)
                stored += 1
                in_a_row[episode.task] = []
            else:
                store.fail(episode)
                failed = in_a_row.setdefault(episode.task, [])
                failed.append(episode.outcome)
                _give_up_after(episode.task, failed)
            speed = (stored - before) / (time.monotonic() - started)
            note = f"{speed:.1f} episodes/s, expert {stored / (len(store.tried) - damaged):.0%}"
            progress.update(task, completed=stored, description=note)


def _give_up_after(task: str, failures: Sequence[str]) -> None:
    if len(failures) >= PATIENCE:
        raise ValueError(
            f"the expert failed on {len(failures)} seeds of {task} in a row ({dict(Counter(failures))}): watch it with "
            "job=preview, or simplify the task"
        )


class DemonstrationWorker:
    """Worker with one environment and one expert."""

    def __init__(self, make_environment: EnvironmentFactory, make_expert: ExpertFactory) -> None:
        self._environment = make_environment()
        self._expert = make_expert(self._environment)

    def attempt(self, seed: int) -> Episode:
        """Roll out one seed and replay it if it succeeds; failures lose their observations."""
        episode = rollout(self._environment, self._expert, seed)
        if episode.success and not _is_reproducible(self._environment, episode):
            episode.outcome = NOT_REPEATABLE
        return episode if episode.success else replace(episode, observations=[])

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()


def _is_reproducible(environment: Environment, episode: Episode) -> bool:
    """Return whether the executed actions reproduce the states, bit for bit, and the success."""
    with environment.blind():
        return replay(environment, episode) is None
