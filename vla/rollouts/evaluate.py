"""Evaluation of a policy on unseen seeds.

An episode is a function of its seed alone, so a report does not depend on the cluster or the number of workers.
"""

from __future__ import annotations

import json
import logging
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vla.io.errors import UserError
from vla.parallel.pool import THIS_PROCESS, Cluster, Crashed, Future, Pool
from vla.rollouts.motion import motion_of
from vla.rollouts.recordings import Recordings, chosen
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.rollout import AgentFactory, EnvironmentFactory, close_agent
from vla.rollouts.worlds import Stage, WorldsHere, in_lanes
from vla.rollouts.worlds import play as play_worlds
from vla.spec import FIRST_SEED, Agent, Agents, Environment, Episode, Recorder

log = logging.getLogger(__name__)

ROUNDS = 4  # episodes of a lane that a process plays at a time: lanes whose episodes are over wait for the others

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
    known: Mapping[int, Result] | None = None,
    keep: Callable[[Result], None] | None = None,
    lanes: int = 1,
) -> Report:
    """Play the episodes of the seeds; `name` is the label of the progress bar.

    `recordings` says which episodes are recorded. Unless that is all, it is known at the end only which they are: these
    are played once more and recorded.

    Every process of the `cluster` calls the factories once. Errors of a factory end the
    evaluation; errors of an episode, or a crash of its process, are reported in its result.

    With `until` the evaluation stops as soon as `until(report on the first n seeds)` is true; n is a multiple of
    `turns`, the number of tasks if seeds cycle through tasks. Results of later seeds are discarded, so that the report
    does not depend on the number of workers.

    Episodes whose seeds are in `known`, seed → result, are not played again. `keep` is called with every other result
    as soon as there is one, unless it is an error.

    Agents that are `vla.spec.Agents` act in so many `lanes` side by side in every process.

    Raises:
        UserError: there are no seeds, seeds are in the range of collection, or the cluster raises one.
    """
    if not seeds or min(seeds) < FIRST_SEED:
        raise UserError(f"evaluation needs seeds from {FIRST_SEED} on, which no policy is trained on; got {seeds}")
    make = partial(_RolloutWorker, make_environment, make_agent, None if recordings == 0 else make_recorder, lanes)
    at_once = recordings == "all"
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
    results = {seed: known[seed] for seed in seeds if seed in known} if known else {}
    counted = 0

    def reported() -> Report:
        return Report(tuple(results[seed] for seed in seeds[:counted]), anytime=until is not None)

    def clear() -> bool:
        """Count the results that no missing one precedes; return whether they suffice."""
        nonlocal counted
        while counted < len(seeds) and seeds[counted] in results:
            counted += 1
            if until is not None and counted % turns == 0 and until(reported()):
                return True
        return False

    with cluster.pool(make) as pool, Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task("", total=len(seeds), completed=len(results), note="")
        missing = [] if clear() else [seed for seed in seeds if seed not in results]
        size = 1 if lanes == 1 else ROUNDS * lanes
        groups = [missing[first : first + size] for first in range(0, len(missing), size)]
        group_of = {pool.submit((group, at_once)): group for group in groups}
        for future in pool.as_completed(group_of):
            for result in _results(pool, future, group_of[future], at_once):
                results[result.seed] = result
                if keep is not None and result.outcome != ERROR:
                    keep(result)
            so_far = Report(tuple(results.values()))
            errors = f", {len(so_far.errors)} errors" if so_far.errors else ""
            bar.update(task, completed=len(results), note=f"success {100 * so_far.success:.0f} %{errors}")
            if clear():
                for later in group_of:
                    later.cancel()
                break
        report = reported()
        if make_recorder is not None and not at_once:
            _record(pool, chosen(report, recordings))
    return report


def _results(pool: Pool, future: Future, seeds: Sequence[int], recorded: bool) -> list[Result]:
    """Return the results of episodes that were played side by side; if the process crashed, play each of them alone."""
    try:
        return future.result()
    except Crashed as crash:
        if len(seeds) == 1:
            return [Result(seeds[0], ERROR, error=str(crash))]
        alone = [pool.submit(([seed], recorded)) for seed in seeds]
        return [_results(pool, one, [seed], recorded)[0] for one, seed in zip(alone, seeds, strict=True)]


def _record(pool: Pool, results: Sequence[Result]) -> None:
    """Play episodes once more and record them; log a warning for those that are played differently."""
    expected = {pool.submit(([result.seed], True)): result for result in results}
    for future in pool.as_completed(expected):
        result = expected[future]
        try:
            again = future.result()[0]
        except Crashed as crash:
            again = Result(result.seed, ERROR, error=str(crash))
        if again.outcome != result.outcome:
            ended = again.error or again.outcome
            log.warning("seed %d has no recording: when played again it ended with %s", result.seed, ended)
        elif again.steps != result.steps:
            took = "seed %d is recorded as played again: in %d steps, where it had taken %d"
            log.warning(took, result.seed, again.steps, result.steps)


def play(environment: Environment, agent: Agent, seed: int, recorder: Recorder | None = None) -> Result:
    """Play one episode; errors become results, so that one seed ends neither an evaluation nor a training."""
    worlds = WorldsHere([Stage(environment, recorder)])
    ((_, ended),) = play_worlds(worlds, in_lanes(agent), [seed], recorder is not None, recorder is not None)
    return result_of(seed, ended, environment.spec.control_hz)


def result_of(seed: int, ended: Episode | Exception, control_hz: float) -> Result:
    """Summarise what `vla.rollouts.worlds.play` makes of a seed, at so many steps per second [Hz]."""
    try:
        if isinstance(ended, Exception):
            raise ended
        episode, motion = ended, motion_of(ended, control_hz)
        # Worlds may give arrays; plain values support comparison and JSON.
        draws, completed, _ = json.loads(
            json.dumps(
                [episode.draws, episode.completed, asdict(motion)],
                default=lambda value: value.tolist(),
                allow_nan=False,
            )
        )
    except Exception as problem:
        where = traceback.extract_tb(problem.__traceback__)[-1]
        what = f"{type(problem).__name__}: {problem} ({Path(where.filename).name}:{where.lineno})"
        return Result(seed, ERROR, error=what)
    steps, milestones = len(episode.observations), tuple(sorted(episode.milestones))
    return Result(
        seed,
        episode.outcome,
        episode.instruction,
        steps,
        draws,
        episode.task,
        milestones,
        completed=completed and tuple(completed),
        motion=motion,
    )


class _LenientRecorder:
    """Recorder that logs disk errors, which must not fail an episode."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.start, self.step = recorder.start, recorder.step

    def end(self, episode: Episode) -> None:
        """Write the recording, or log a warning."""
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
        first = make_environment()
        self._agent = make_agent(first)
        others = range(1, lanes if isinstance(self._agent, Agents) else 1)
        self._environments = [first, *(make_environment() for _ in others)]
        recorders = [None if make_recorder is None else _LenientRecorder(make_recorder()) for _ in self._environments]
        self._worlds = WorldsHere([Stage(*each) for each in zip(self._environments, recorders, strict=True)])

    def attempt(self, item: tuple[Sequence[int], bool]) -> list[Result]:
        """Play the episodes of seeds, and record them if the second part of the item says so."""
        seeds, recorded = item
        played = play_worlds(self._worlds, in_lanes(self._agent), seeds, recorded, recorded)
        return [result_of(seed, ended, self._worlds.spec.control_hz) for seed, ended in played]

    def close(self) -> None:
        """Close the environments and the agent."""
        for environment in self._environments:
            environment.close()
        close_agent(self._agent)
