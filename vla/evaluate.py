"""Many rollouts of a policy on seeds that it was never trained on: how often it succeeds, and how it fails.

An episode is a function of its seed alone, so a report is the same whatever the number of workers.
"""

from __future__ import annotations

import json
import logging
import traceback
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import as_completed
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vla.intervals import wilson_interval
from vla.rollout import rollout
from vla.spec import FIRST_SEED, Agent, Environment, Episode, Recorder
from vla.workers import Pool, WorkersLost, cores, one_thread_each

log = logging.getLogger(__name__)

SEEN = "seen"  # the condition that a policy was trained for
TAKEN = ("success", "dropped", "not_placed", "timeout")  # outcomes of episodes in which the named block was taken
WORKERS = "evaluate.workers"  # how many processes, in the configuration
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
        raise ValueError(f"evaluation needs at least one worker, got {WORKERS}={workers}")
    make = partial(_Player, make_environment, make_agent, make_recorder)
    play = _play_here(make, seeds) if workers == 1 else _play_apart(make, seeds, workers)
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


class _Onlooker:
    """A recorder whose disk may fill up: its recordings only show results, so they cost no episode."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.start, self.step = recorder.start, recorder.step

    def end(self, episode: Episode) -> None:
        """Write the recording, or say that it is missing."""
        try:
            self._recorder.end(episode)
        except OSError as error:
            log.warning("seed %d has no recording: %s", episode.seed, error)


class _Player:
    """One process's environment, agent and recorder."""

    def __init__(
        self, make_environment: MakeEnvironment, make_agent: MakeAgent, make_recorder: MakeRecorder | None
    ) -> None:
        self._environment = make_environment()
        self._agent = make_agent(self._environment)
        self._recorder = None if make_recorder is None else _Onlooker(make_recorder())

    def attempt(self, seed: int) -> Result:
        """Play one episode."""
        return play(self._environment, self._agent, seed, self._recorder)

    def close(self) -> None:
        """Free the environment."""
        self._environment.close()


def _play_here(make: Callable[[], _Player], seeds: Sequence[int]) -> Generator[Result]:
    with closing(make()) as player:
        for seed in seeds:
            yield player.attempt(seed)


def _play_apart(make: Callable[[], _Player], seeds: Sequence[int], workers: int) -> Generator[Result]:
    """Results in the order in which they come, from other processes."""
    with Pool(make, min(workers, len(seeds)), WORKERS) as pool:
        seed_of = {pool.submit(seed): seed for seed in seeds}
        for future in as_completed(seed_of):
            try:
                yield future.result()
            except WorkersLost as lost:
                what = f"the worker process for this episode crashed twice: {lost}. Run with {WORKERS}=1"
                yield Result(seed_of[future], ERROR, error=f"{what} for the traceback.")
