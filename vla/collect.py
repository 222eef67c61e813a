"""Many rollouts of the expert into an episode store: in parallel, verified, the same whatever the number of workers.

Seeds are tried in order and committed in order, until the store holds as many successes as were asked for.
"""

from __future__ import annotations

import logging
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Protocol

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vla.data.episodes import EpisodeStore
from vla.rollout import replay, rollout
from vla.spec import Agent, Environment, Episode
from vla.workers import leave_with_parent, one_thread_each

log = logging.getLogger(__name__)

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
Submit = Callable[[int], Future[Episode]]


@dataclass(frozen=True)
class Summary:
    """What a store holds, and what it took."""

    episodes: int  # successes stored
    added: int  # of which were added now
    tried: int  # seeds
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
    workers: int,
    seed: int,
) -> Summary:
    """Roll the expert out on `seed`, `seed` + 1, … until the store holds `episodes` successes.

    What is there already stays and is not made again. Another process that is collecting into the same store is waited
    for. Each of `workers` spawned processes calls the two factories once; a single worker is this process itself.

    Raises:
        ValueError: the store starts at another seed or was not collected, the expert is hopeless, a worker died, or the
            disk is full.
    """
    if workers < 1:
        raise ValueError(f"collect.workers is the number of processes, at least 1, not {workers}")
    started = time.monotonic()
    before = len(store.episodes)
    if before < episodes and store.derived:
        raise ValueError(
            f"{store.folder} was put together from other stores and does not grow: set collect.episodes={before}"
        )
    if before < episodes:
        with store.writing():
            before = len(store.episodes)  # another process may have added some while this one waited
            if store.tried and store.tried[0].seed != seed:
                first = store.tried[0].seed
                raise ValueError(f"{store.folder} starts at seed {first}, not {seed}: set collect.seed={first}")
            if before < episodes:
                workers = min(workers, episodes - before)
                _fill_with(make_environment, make_expert, workers, store, episodes, seed)
    stored = len(store.episodes)
    failures = Counter(entry.outcome for entry in store.tried if not entry.success)
    return Summary(stored, stored - before, len(store.tried), dict(failures), time.monotonic() - started)


def _fill_with(
    make_environment: MakeEnvironment,
    make_expert: MakeExpert,
    workers: int,
    store: EpisodeStore,
    episodes: int,
    seed: int,
) -> None:
    """Fill the store, with new processes if one died: a graphics driver may crash once in thousands of episodes."""
    while True:
        tried = len(store.tried)
        try:
            with _rollouts(make_environment, make_expert, workers) as submit:
                return _fill(store, submit, episodes, LOOK_AHEAD * workers if workers > 1 else 1, seed)
        except BrokenProcessPool as error:
            if len(store.tried) == tried:
                raise ValueError(
                    "the collecting processes die, killed for their memory or by a crash outside Python: what was "
                    "committed is safe, run again with fewer collect.workers, or with 1 to see the crash"
                ) from error
            log.warning("a collecting process died after %d episodes; going on with new ones", len(store.episodes))


def _fill(store: EpisodeStore, submit: Submit, episodes: int, ahead: int, seed: int) -> None:
    stored = before = len(store.episodes)
    next_seed = seed if store.next_seed is None else store.next_seed
    in_a_row = 0  # failures
    started = time.monotonic()
    pending: deque[Future[Episode]] = deque()
    columns = (TextColumn("collecting"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
    with Progress(*columns, TimeRemainingColumn()) as progress:
        task = progress.add_task("", total=episodes, completed=stored)
        while stored < episodes:
            # Never more under way than are missing: an expert that does not fail makes none in vain.
            while len(pending) < min(ahead, episodes - stored):
                pending.append(submit(next_seed))
                next_seed += 1
            episode = pending.popleft().result()
            if episode.success:
                store.append(episode)
                stored, in_a_row = stored + 1, 0
            else:
                store.fail(episode.seed, episode.outcome, episode.draws)
                in_a_row += 1
                _give_up_after(store, in_a_row)
            speed = (stored - before) / (time.monotonic() - started)
            note = f"{speed:.1f} episodes/s, expert {stored / len(store.tried):.0%}"
            progress.update(task, completed=stored, description=note)


def _give_up_after(store: EpisodeStore, in_a_row: int) -> None:
    if in_a_row >= PATIENCE:
        causes = dict(Counter(entry.outcome for entry in store.tried[-in_a_row:]))
        raise ValueError(
            f"the expert failed on {in_a_row} seeds in a row ({causes}): watch it with job=preview, or ease the task"
        )


@contextmanager
def _rollouts(make_environment: MakeEnvironment, make_expert: MakeExpert, workers: int) -> Iterator[Submit]:
    """A function that starts the attempt at a seed and gives its future."""
    with one_thread_each():
        if workers == 1:
            worker = _Worker(make_environment, make_expert)
            try:
                yield lambda seed: _finished(worker.attempt(seed))
            finally:
                worker.close()
            return
        # A GL context does not survive a fork.
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _enter, (make_environment, make_expert))

        def submit(seed: int) -> Future[Episode]:
            # Ctrl-C is for the process that commits: one that is spawned here never hears it.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                return pool.submit(_attempt, seed)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)

        try:
            yield submit
        finally:
            pool.shutdown(cancel_futures=True)


class _Worker:
    """One environment and one expert, made when first needed."""

    def __init__(self, make_environment: MakeEnvironment, make_expert: MakeExpert) -> None:
        self._make_environment, self._make_expert = make_environment, make_expert
        self._pair: tuple[RepeatableEnvironment, Agent] | None = None

    def attempt(self, seed: int) -> Episode:
        """Roll out one seed and, if that succeeds, replay it; only a success keeps its observations."""
        if self._pair is None:
            environment = self._make_environment()
            self._pair = environment, self._make_expert(environment)
        environment, expert = self._pair
        episode = rollout(environment, expert, seed)
        if episode.success and not _repeats(environment, episode):
            episode.outcome = NOT_REPEATABLE
        return episode if episode.success else replace(episode, observations=[])

    def close(self) -> None:
        """Close the environment, if there is one."""
        if self._pair is not None:
            self._pair[0].close()


def _repeats(environment: RepeatableEnvironment, episode: Episode) -> bool:
    """Whether the executed actions lead from the seed to success again, through the same joint angles bit for bit."""
    with environment.blind():
        return replay(environment, episode) is None


_here: _Worker | None = None  # the worker of this process, where this process is one of a pool


def _enter(make_environment: MakeEnvironment, make_expert: MakeExpert) -> None:
    global _here
    leave_with_parent()
    _here = _Worker(make_environment, make_expert)


def _attempt(seed: int) -> Episode:
    assert _here is not None
    return _here.attempt(seed)


def _finished(episode: Episode) -> Future[Episode]:
    future: Future[Episode] = Future()
    future.set_result(episode)
    return future
