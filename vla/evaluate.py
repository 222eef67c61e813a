"""Many rollouts of a policy on seeds that it was never trained on: how often it succeeds, and how it fails.

An episode is a function of its seed alone, so a report is the same whatever the number of workers.
"""

from __future__ import annotations

import json
import logging
import signal
import traceback
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Protocol

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vla.intervals import wilson_interval
from vla.rollout import rollout
from vla.spec import FIRST_SEED, Agent, Environment, Recorder
from vla.workers import cores, leave_with_parent, one_thread_each

log = logging.getLogger(__name__)

SEEN = "seen"  # the condition that a policy was trained for
TAKEN = ("success", "dropped", "not_placed", "timeout")  # outcomes of episodes in which the named block was taken
ERROR = "error"  # outcome of an episode that could not be played to its end


class ClosableEnvironment(Environment, Protocol):
    """An environment that holds something, such as a renderer."""

    def close(self) -> None:
        """Free it."""
        ...


MakeEnvironment = Callable[[], ClosableEnvironment]
MakeAgent = Callable[[Environment], Agent]
MakeRecorder = Callable[[], Recorder]


@dataclass(frozen=True)
class Result:
    """What became of one episode."""

    seed: int
    outcome: str  # "success", the name of a failure, or "error"
    instruction: str = ""
    steps: int = 0
    draws: dict[str, Any] = field(default_factory=dict)  # randomisation axis → what was drawn, plain values
    error: str = ""  # what went wrong, where the outcome is "error"


@dataclass(frozen=True)
class Report:
    """What became of all episodes, in the order of their seeds.

    An error says something about the program, not about the policy: it counts neither as a success nor as a failure.
    """

    results: tuple[Result, ...]

    @property
    def errors(self) -> list[Result]:
        """The episodes that could not be played to their end."""
        return [result for result in self.results if result.outcome == ERROR]

    @property
    def episodes(self) -> int:
        """How many were played to their end."""
        return len(self.results) - len(self.errors)

    @property
    def successes(self) -> int:
        """How many succeeded."""
        return self.taxonomy.get("success", 0)

    @property
    def success(self) -> float:
        """Share of the episodes that succeeded, 0…1; 0 where none was played to its end."""
        return self.successes / self.episodes if self.episodes else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of `success`."""
        return wilson_interval(self.successes, self.episodes)

    @property
    def taken(self) -> float:
        """Share of the episodes in which the block that was named was taken, wherever it went, 0…1."""
        return sum(self.taxonomy.get(outcome, 0) for outcome in TAKEN) / self.episodes if self.episodes else 0.0

    @property
    def taxonomy(self) -> dict[str, int]:
        """Outcome → episodes, the most frequent first."""
        return dict(Counter(result.outcome for result in self.results).most_common())

    @property
    def goals(self) -> dict[str, Report]:
        """Goal → report on the episodes that asked for it, by name; an error before the first scene asked for none."""
        asked: dict[str, list[Result]] = {}
        for result in self.results:
            if goal := result.draws.get("named", {}).get("goal"):
                asked.setdefault(goal, []).append(result)
        return {goal: Report(tuple(asked[goal])) for goal in sorted(asked)}

    def __str__(self) -> str:
        """Failures, errors, goals if there are several and, on the last line, the success rate with its interval."""
        lines = [f"{outcome} {count}" for outcome, count in self.taxonomy.items() if outcome not in ("success", ERROR)]
        if self.errors:
            first = self.errors[0]
            lines.append(f"errors {len(self.errors)}, the first at seed {first.seed}: {first.error}")
        if len(self.goals) > 1:
            lines += [f"{goal} {report._rate()}" for goal, report in self.goals.items()]
        return "\n".join([*lines, f"success {self._rate()}"])

    def _rate(self) -> str:
        low, high = self.interval
        share = f"{100 * self.success:.1f} %, 95 % CI {100 * low:.1f}-{100 * high:.1f}"
        return f"{self.successes}/{self.episodes} ({share})"


def evaluate(
    make_environment: MakeEnvironment,
    make_agent: MakeAgent,
    make_recorder: MakeRecorder | None,
    seeds: Sequence[int],
    workers: int | None = None,
    name: str = "evaluating",
) -> Report:
    """Play the episodes that the seeds name; `name` stands beside the progress.

    The factories are called once in each of `workers` spawned processes (None: one per core); a single worker is this
    process itself. What they raise ends the evaluation; what an episode raises is reported as its error.

    Raises:
        ValueError: no seeds, seeds that collection might use, or no workers.
    """
    if not seeds or min(seeds) < FIRST_SEED:
        raise ValueError(f"evaluation needs seeds from {FIRST_SEED} on, which no policy is trained on; got {seeds}")
    workers = cores() if workers is None else workers
    if workers < 1:
        raise ValueError(f"evaluation needs at least one worker, got evaluate.workers={workers}")
    factories = _Factories(make_environment, make_agent, make_recorder)
    play = _play_here(factories, seeds) if workers == 1 else _play_apart(factories, seeds, workers)
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
    results: dict[int, Result] = {}
    with one_thread_each(), closing(play), Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task("", total=len(seeds), note="")
        for result in play:
            results[result.seed] = result
            so_far = Report(tuple(results.values()))
            errors = f", {len(so_far.errors)} errors" if so_far.errors else ""
            bar.update(task, advance=1, note=f"success {100 * so_far.success:.0f} %{errors}")
    return Report(tuple(results[seed] for seed in seeds))


def keep_recordings(report: Report, folder: Path, target: Path, limit: int | None) -> int:
    """Merge an evaluation's recordings into one file, failures first and at most `limit` if given; returns how many.

    The single files are removed, and their folder if nothing else is in it.
    """
    from vla.record import merge, recording_name  # the viewer's library is needed only here

    names = sorted(recording_name(result.seed, result.outcome) for result in report.results)
    files = [file for name in names if (file := folder / f"{name}.rrd").exists()]
    if files[:limit]:
        merge(files[:limit], target)
    for file in files:
        file.unlink()
    with suppress(OSError):
        folder.rmdir()
    return len(files[:limit])


def play(environment: Environment, agent: Agent, seed: int, recorder: Recorder | None = None) -> Result:
    """Play one episode; never raises, so that one bad seed does not cost the others, or a training."""
    try:
        episode = rollout(environment, agent, seed, recorder)
    except Exception as problem:
        where = traceback.extract_tb(problem.__traceback__)[-1]
        what = f"{type(problem).__name__}: {problem} ({Path(where.filename).name}:{where.lineno})"
        return Result(seed, ERROR, error=what)
    # Draws may come as arrays; plain values compare, and fit into JSON.
    draws = json.loads(json.dumps(episode.draws, default=lambda value: value.tolist()))
    return Result(seed, episode.outcome, episode.instruction, len(episode.observations), draws)


@dataclass(frozen=True)
class _Factories:
    environment: MakeEnvironment
    agent: MakeAgent
    recorder: MakeRecorder | None


class _Player:
    """One process's environment, agent and recorder."""

    def __init__(self, make: _Factories) -> None:
        self._environment = make.environment()
        self._agent = make.agent(self._environment)
        self._recorder = None if make.recorder is None else make.recorder()

    def play(self, seed: int) -> Result:
        """Play one episode."""
        return play(self._environment, self._agent, seed, self._recorder)

    def close(self) -> None:
        """Free the environment."""
        self._environment.close()


def _play_here(factories: _Factories, seeds: Sequence[int]) -> Generator[Result]:
    with closing(_Player(factories)) as player:
        for seed in seeds:
            yield player.play(seed)


def _play_apart(factories: _Factories, seeds: Sequence[int], workers: int) -> Generator[Result]:
    """Results in the order in which they come, from other processes.

    When one dies, the episodes that were under way are played again, one by one: in long runs a process was seen to
    crash outside Python, and an episode that kills its process again is an error of its own.
    """
    left = list(seeds)
    while left:
        for result in _play_in_pool(factories, left, workers):
            left.remove(result.seed)
            yield result
        suspects, left = left[:workers], left[workers:]
        if suspects:
            log.warning("a process died; playing the episodes that it may have been at again")
        for seed in suspects:
            what = "the process that played this episode died, twice; evaluate.workers=1 would show where"
            yield from list(_play_in_pool(factories, [seed], 1)) or [Result(seed, ERROR, error=what)]


def _play_in_pool(factories: _Factories, seeds: Sequence[int], workers: int) -> Generator[Result]:
    """Results until all are there, or a process dies; they are spawned, as a GL context does not survive a fork."""
    pool = ProcessPoolExecutor(min(workers, len(seeds)), get_context("spawn"), _start_worker, (factories,))
    try:
        for future in as_completed([pool.submit(_play_in_worker, seed) for seed in seeds]):
            yield future.result()
    except BrokenProcessPool:
        return
    finally:
        pool.shutdown(cancel_futures=True)


_factories: _Factories
_player: _Player | None = None


def _start_worker(factories: _Factories) -> None:
    global _factories
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    leave_with_parent()
    _factories = factories


def _play_in_worker(seed: int) -> Result:
    """Built with the first episode, not at the start of the process: only then do exceptions reach the parent."""
    global _player
    if _player is None:
        _player = _Player(_factories)
        # Runs before atexit's callbacks, among which GL's end would come first.
        Finalize(None, _player.close, exitpriority=0)
    return _player.play(seed)
