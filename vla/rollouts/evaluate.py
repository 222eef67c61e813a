"""Evaluation of a policy on unseen seeds.

An episode is a function of its seed alone, so a report does not depend on the cluster or the number of workers.
"""

from __future__ import annotations

import json
import logging
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from vla.io.errors import UserError, counted
from vla.io.progress import Bar
from vla.parallel.pool import THIS_PROCESS, Cluster, Future, Pool, WorkerCrash
from vla.rollouts.motion import motion_of
from vla.rollouts.recordings import Recordings, choose_results
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.rollout import AgentFactory, EnvironmentFactory, close_agent
from vla.rollouts.worlds import Stage, as_agents, play
from vla.spec import FIRST_SEED, Agent, Agents, Environment, Episode, Recorder

log = logging.getLogger(__name__)

ROUNDS = 4  # episodes per lane in one work item, at the end of which lanes wait for each other

RecorderFactory = Callable[[], Recorder]


def evaluate(
    make_environment: EnvironmentFactory,
    make_agent: AgentFactory,
    make_recorder: RecorderFactory | None,
    seeds: Sequence[int],
    cluster: Cluster = THIS_PROCESS,
    name: str = "evaluating",
    until: Callable[[Report], bool] | None = None,
    recordings: Recordings = "all",
    turns: int = 1,
    known_results: Mapping[int, Result] | None = None,
    on_result: Callable[[Result], None] | None = None,
    lanes: int = 1,
) -> Report:
    """Play the episodes of the seeds; `name` is the label of the progress bar.

    Every process of the `cluster` calls the factories once; agents that are `vla.spec.Agents` act in `lanes` worlds
    side by side in each. `recordings` says which episodes are recorded: unless it is all of them, they are chosen at
    the end and played once more. Errors of a factory end the evaluation; an error or a crash of an episode is a result.

    With `until` the evaluation stops as soon as `until(report on the first n seeds)` is true; n is a multiple of
    `turns`, the number of tasks if seeds cycle through tasks, and beyond a thousand it grows by a thousandth at a
    time. Results of later seeds are discarded, so that the report does not depend on the number of workers.

    Episodes whose seeds are in `known_results`, seed → result, are not played again. `on_result` is called with every
    new result but errors. Raises a UserError if there are no seeds, seeds are in the range of collection, or the
    cluster raises one.
    """
    if not seeds or min(seeds) < FIRST_SEED:
        raise UserError(f"evaluation needs seeds from {FIRST_SEED} on, which no policy is trained on; got {seeds}")
    make = partial(_RolloutWorker, make_environment, make_agent, None if recordings == 0 else make_recorder, lanes)
    record_all, score = recordings == "all", _Score(seeds, dict(known_results or {}), until, turns)
    with cluster.pool(make) as pool:
        _play_missing(
            pool, score, record_all, 1 if lanes == 1 else ROUNDS * lanes, name, on_result or (lambda result: None)
        )
        report = score.report()
        if make_recorder is not None and not record_all and (results := choose_results(report, recordings)):
            _record(pool, results)
    return report


def _play_missing(
    pool: Pool, score: _Score, recorded: bool, size: int, name: str, keep: Callable[[Result], None]
) -> None:
    """Play the missing episodes in groups of `size`, until `score.until` is true of the results that count."""
    with Bar(name, len(score.seeds), len(score.results), score.note() if score.results else "") as bar:
        seeds = [] if score.advance() else [seed for seed in score.seeds if seed not in score.results]
        groups = [seeds[start : start + size] for start in range(0, len(seeds), size)]
        group_of, crashed, decided = {pool.submit((group, recorded)): group for group in groups}, False, False
        for future in pool.as_completed(group_of):
            results = _results(future, group_of[future])
            crashed |= not results
            for result in results:
                score.add(result)
                if result.outcome != ERROR:
                    keep(result)
            bar.show(len(score.results), score.note())
            decided = score.advance()
            if decided or (crashed and score.until is not None):  # later results count only after those of a crash
                for pending in group_of:
                    pending.cancel()
                break
    if crashed and not decided:  # one by one, to find out which of the episodes in a group it was
        _play_missing(pool, score, recorded, 1, name, keep)


@dataclass
class _Score:
    """Results so far, in any order; only those of seeds before the first missing one count."""

    seeds: Sequence[int]
    results: dict[int, Result]
    until: Callable[[Report], bool] | None
    turns: int
    counted: int = 0
    asked: int = 0  # value of `counted` when `until` was asked last
    outcomes: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.outcomes.update(result.outcome for result in self.results.values())

    def add(self, result: Result) -> None:
        self.results[result.seed] = result
        self.outcomes[result.outcome] += 1

    def report(self) -> Report:
        """Report the results that count."""
        return Report(tuple(self.results[seed] for seed in self.seeds[: self.counted]), anytime=self.until is not None)

    def advance(self) -> bool:
        """Count results up to the first that is missing, or until `until` is true of them; return whether it is."""
        while self.counted < len(self.seeds) and self.seeds[self.counted] in self.results:
            self.counted += 1
            # An answer takes time in proportion to the results: asked after every one, it would grow with their square.
            due = self.counted > self.asked + self.asked // 1000 and self.counted % self.turns == 0
            if self.until is not None and due:
                self.asked = self.counted
                if self.until(self.report()):
                    return True
        return False

    def note(self) -> str:
        """Format the success so far."""
        errors = self.outcomes[ERROR]
        completed = self.outcomes.total() - errors
        share = self.outcomes["success"] / completed if completed else 0.0
        return f"success {100 * share:.0f} %" + (f", {counted(errors, 'error')}" if errors else "")


def _results(future: Future, seeds: Sequence[int]) -> list[Result]:
    """Return the results of a group of episodes; after a crash none, or an error result if the group is one episode."""
    try:
        return future.result()
    except WorkerCrash as crash:
        return [Result(seeds[0], ERROR, error=str(crash))] if len(seeds) == 1 else []


def _record(pool: Pool, results: Sequence[Result]) -> None:
    """Play episodes once more and record them; log a warning for those that are played differently."""
    originals = {pool.submit(([result.seed], True)): result for result in results}
    with Bar("recording", len(originals)) as bar:
        for count, future in enumerate(pool.as_completed(originals), 1):
            result = originals[future]
            (repeat,) = _results(future, [result.seed])
            bar.show(count)
            if repeat.outcome != result.outcome:
                outcome = repeat.error or repeat.outcome
                log.warning("seed %d has no recording: when played again it ended with %s", result.seed, outcome)
            elif repeat.steps != result.steps:
                text = "the recording of seed %d differs from the evaluation: it has %d steps, not %d"
                log.warning(text, result.seed, repeat.steps, result.steps)


def play_episode(environment: Environment, agent: Agent, seed: int) -> Result:
    """Play one episode, as `play_episodes`."""
    return play_episodes([environment], agent, [seed])[0]


def play_episodes(
    environments: Sequence[Environment],
    agent: Agent | Agents,
    seeds: Sequence[int],
    recorders: Sequence[Recorder] | None = None,
) -> list[Result]:
    """Play the episodes of seeds side by side in worlds of one kind, and record them if every world has a recorder.

    An agent that is not `vla.spec.Agents` acts in one world only. Results are in the order in which episodes end;
    errors become results, so that one seed ends neither an evaluation nor a training.
    """
    pairs = zip(environments, recorders or [None] * len(environments), strict=True)
    results = play([Stage(*pair) for pair in pairs], as_agents(agent), seeds, all_images=recorders is not None)
    return [result_of(seed, result, environments[0].spec.control_hz) for seed, result in results]


def result_of(seed: int, ending: Episode | Exception, control_hz: float) -> Result:
    """Summarise the episode, or the error, that `play` yields for a seed; `control_hz` is the steps per second."""
    try:
        if isinstance(ending, Exception):
            raise ending
        # Worlds may give arrays; plain values support comparison and JSON.
        motion = motion_of(ending, control_hz)
        facts = [ending.draws, ending.completed, asdict(motion)]
        draws, completed, _ = json.loads(json.dumps(facts, default=lambda value: value.tolist(), allow_nan=False))
        return Result(
            seed,
            ending.outcome,
            ending.instruction,
            len(ending.observations),
            draws,
            ending.task,
            tuple(sorted(ending.milestones)),
            completed=completed and tuple(completed),
            motion=motion,
        )
    except Exception as problem:  # of any kind: worlds are user code
        frame = traceback.extract_tb(problem.__traceback__)[-1]
        message = f"{type(problem).__name__}: {problem} ({Path(frame.filename).name}:{frame.lineno})"
        return Result(seed, ERROR, error=message)


class _LenientRecorder:
    """Recorder that logs disk errors, which must not fail an episode."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.start, self.step = recorder.start, recorder.step

    def end(self, episode: Episode) -> None:
        try:
            self._recorder.end(episode)
        except OSError as error:
            log.warning("seed %d has no recording: %s", episode.seed, error)


class _RolloutWorker:
    """Worker with an environment and a recorder in every lane, and the agent in them."""

    def __init__(
        self,
        make_environment: EnvironmentFactory,
        make_agent: AgentFactory,
        make_recorder: RecorderFactory | None,
        lanes: int,
    ) -> None:
        with ExitStack() as stack:  # closes what there is if a part fails
            self._environments = [stack.enter_context(closing(make_environment()))]
            self._agent = make_agent(self._environments[0])
            stack.callback(close_agent, self._agent)
            for _ in range(1, lanes if isinstance(self._agent, Agents) else 1):
                self._environments.append(stack.enter_context(closing(make_environment())))
            self._recorders = [_LenientRecorder(make_recorder()) for _ in self._environments] if make_recorder else None
            self.close = stack.pop_all().close

    def attempt(self, item: tuple[Sequence[int], bool]) -> list[Result]:
        """Play the episodes of seeds, and record them if the second part of the item says so."""
        seeds, recorded = item
        return play_episodes(self._environments, self._agent, seeds, self._recorders if recorded else None)
