"""Collection of expert episodes into a store: parallel, verified, independent of the number of workers.

Seeds are tried and committed in order, until the store holds the requested number of successes. Where the environment
tells the task of a seed beforehand, tasks advance together: a seed is passed over while its task is ahead of another.
The first n episodes per task are then the same however many are collected.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial

from vla.data.episodes import EpisodeStore
from vla.data.index import DAMAGED, NOT_NEEDED
from vla.io.errors import UserError, counted
from vla.io.progress import Bar
from vla.parallel.pool import Cluster, Future, Pool, WorkersLost
from vla.parallel.processes import WorkerFactory
from vla.rollouts.rollout import AgentFactory, EnvironmentFactory, close_agent, replay, rollout
from vla.spec import FIRST_SEED, Episode, Multitask

log = logging.getLogger(__name__)

MAX_FAILURES = 50  # consecutive failures at a task before collection is given up
LOOK_AHEAD = 4  # pending episodes per worker: a long one must not block the others
NOT_REPEATABLE = "not_repeatable"  # outcome of a success that the replay of its actions does not reproduce


@dataclass(frozen=True)
class Summary:
    """Result of a collection."""

    episodes: int  # stored
    successes: int  # of the tried seeds
    added: int  # episodes that this call stored
    attempts: int  # seeds of known outcome, that is, without the episodes lost in a repair
    failures: dict[str, int]  # outcome → seeds
    tasks: dict[str, tuple[int, int]]  # task → successes, seeds tried
    seconds: float  # of this call

    @classmethod
    def from_store(cls, store: EpisodeStore, added: int, seconds: float) -> Summary:
        """Summarise a store."""
        tried = [entry for entry in store.attempts if entry.outcome not in (DAMAGED, NOT_NEEDED)]
        failures = Counter(entry.outcome for entry in tried if not entry.success)
        solved, tries = Counter(entry.task for entry in tried if entry.success), Counter(entry.task for entry in tried)
        tasks = {task: (solved[task], tries[task]) for task in sorted(tries)}
        return cls(len(store.episodes), solved.total(), added, len(tried), dict(failures), tasks, seconds)

    @property
    def success_rate(self) -> float:
        """Share of the tried seeds that the expert solved, 0…1."""
        return self.successes / self.attempts if self.attempts else 0.0


def collect(
    store: EpisodeStore,
    make_environment: EnvironmentFactory,
    make_expert: AgentFactory,
    episodes: int,
    cluster: Cluster,
    seed: int,
    multitask: Multitask | None = None,
    keep_failures: bool = False,
) -> Summary:
    """Roll the expert out on `seed`, `seed` + 1, … until the store holds `episodes` successes.

    Existing episodes are kept. If another process is collecting into the same store, wait for it. Each process of
    `cluster` calls the two factories once. `multitask` tells the task of a seed; its tasks get equal shares. With
    `keep_failures` every seed gives an episode: failures are stored and count too. Raises a UserError if the store
    starts at another seed or is derived, the expert fails persistently, workers died, or the disk is full.
    """
    start, initial_count = time.monotonic(), len(store.episodes)
    store.require_first_seed(seed)
    if initial_count < episodes:
        store.require_growable()
        with store.writing():  # waits for another process, which may have added some
            initial_count = len(store.episodes)
            store.require_first_seed(seed)
            if initial_count < episodes:
                make = partial(DemonstrationWorker, make_environment, make_expert, keep_failures)
                _fill_with(cluster, make, store, partial(_fill, store, episodes, seed, multitask, keep_failures))
    return Summary.from_store(store, len(store.episodes) - initial_count, time.monotonic() - start)


def _fill_with(cluster: Cluster, make: WorkerFactory, store: EpisodeStore, fill: Callable[[Pool], None]) -> None:
    """Fill the store, restarting workers that died: in long collections processes occasionally crash outside Python."""
    while True:
        attempts = len(store.attempts)
        try:
            with cluster.pool(make) as pool:
                return fill(pool)
        except WorkersLost as lost:
            if len(store.attempts) == attempts:
                raise WorkersLost(f"{lost}; committed episodes are safe, run again to continue") from lost
            log.warning("workers were lost after %s; continuing with new ones", counted(len(store.episodes), "episode"))


class _Attempts:
    """Episodes in the order of their seeds.

    They are rolled out in advance for tasks that would need more even if all pending episodes succeed.
    """

    def __init__(self, pool: Pool, multitask: Multitask | None, store: EpisodeStore, first_seed: int) -> None:
        """Continue a store, or begin it at the seed `first_seed`; without `multitask` all seeds are of one task."""
        self._pool = pool
        self._task_of = multitask.task_of if multitask else lambda seed: ""
        self._successes = dict.fromkeys(multitask.tasks if multitask else [""], 0)
        for entry in store.episodes:
            self._successes[self._task_of(entry.seed)] += entry.success
        self._next_seed = first_seed if store.next_seed is None else store.next_seed
        self._pending: deque[tuple[int, Future | None]] = deque()

    def next(self, max_pending: int) -> Episode:
        """Return the episode of the next seed, while at most `max_pending` others are rolled out.

        Its outcome is `NOT_NEEDED` if its task is ahead of another one.
        """
        self._advance(max_pending)
        seed, future = self._pending.popleft()
        task = self._task_of(seed)
        if not _is_needed(task, self._successes):
            return Episode(seed, task, "", NOT_NEEDED)
        episode: Episode = (future or self._pool.submit(seed)).result()
        self._successes[task] += episode.success
        return episode

    def _advance(self, max_pending: int) -> None:
        seeds = [seed for seed, future in self._pending if future is not None]
        expected = Counter(self._successes) + Counter(self._task_of(seed) for seed in seeds)
        expected = {task: expected[task] for task in self._successes}
        missing = max_pending - len(seeds)
        while missing > 0:
            if self._next_seed >= FIRST_SEED:
                raise UserError(f"seeds from {FIRST_SEED} on are reserved for evaluation: lower collect.seed")
            task = self._task_of(self._next_seed)
            needed = _is_needed(task, expected)
            self._pending.append((self._next_seed, self._pool.submit(self._next_seed) if needed else None))
            expected[task] += needed
            missing -= needed
            self._next_seed += 1


def _is_needed(task: str, successes: Mapping[str, int]) -> bool:
    return successes[task] == min(successes.values())


def _fill(
    store: EpisodeStore, episodes: int, seed: int, multitask: Multitask | None, keep_failures: bool, pool: Pool
) -> None:
    """Append episodes until the store has `episodes`; raise a UserError if the expert fails too often in a row."""
    initial_count, attempts, start = len(store.episodes), _Attempts(pool, multitask, store, seed), time.monotonic()
    outcomes = Counter(entry.success for entry in store.attempts if entry.outcome not in (DAMAGED, NOT_NEEDED))
    in_a_row = defaultdict[str, list[str]](list)  # task → outcomes of the failures since its last success
    with Bar("collecting", episodes, initial_count) as bar:
        while (stored := len(store.episodes)) < episodes:
            # No more pending than missing: without failures no episode is wasted.
            episode = attempts.next(min(LOOK_AHEAD * pool.size, episodes - stored))
            if episode.outcome == NOT_NEEDED:
                store.fail(episode)
                continue
            outcomes[episode.success] += 1
            if episode.success or keep_failures:
                store.append(episode)
                in_a_row[episode.task] = []
            else:
                store.fail(episode)
                failures = in_a_row[episode.task]
                failures.append(episode.outcome)
                if len(failures) >= MAX_FAILURES:
                    raise UserError(
                        f"the expert failed on {len(failures)} seeds of {episode.task} in a row "
                        f"({dict(Counter(failures))}): watch it with job=preview, or simplify the task"
                    )
            speed = 60 * (len(store.episodes) - initial_count) / (time.monotonic() - start)
            rate = outcomes[True] / outcomes.total()
            bar.show(len(store.episodes), f"{speed:.0f} episodes/min, success {rate:.0%}")


class DemonstrationWorker:
    """Worker with one environment and one expert."""

    def __init__(
        self, make_environment: EnvironmentFactory, make_expert: AgentFactory, keep_failures: bool = False
    ) -> None:
        self._keep_failures = keep_failures
        self._environment = make_environment()
        self._expert = make_expert(self._environment)

    def attempt(self, seed: int) -> Episode:
        """Roll out one seed, and verify a success by a replay, which must go through the same states, bit for bit.

        Images that the expert does not look at are rendered in the replay; failures that are not kept never need them.
        """
        episode = rollout(self._environment, self._expert, seed, all_images=self._keep_failures)
        if episode.success:
            complete = all(observation.rgb for observation in episode.observations)
            with self._environment.blind() if complete else nullcontext():
                result = replay(self._environment, episode)
            if result.first_difference is not None:
                episode.outcome = NOT_REPEATABLE
            elif not complete:
                episode.observations = result.observations
        return episode if episode.success or self._keep_failures else replace(episode, observations=[])

    def close(self) -> None:
        """Close the environment and the expert."""
        self._environment.close()
        close_agent(self._expert)
