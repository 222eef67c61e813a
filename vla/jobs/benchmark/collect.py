"""Throughput of collection and its breakdown, and the throughput of robosuite."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from tempfile import TemporaryDirectory

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.data.episodes import EpisodeStore
from vla.jobs.benchmark.baselines.peer import DURATION, peer
from vla.jobs.benchmark.measure import HasMinimalStep, Measure, measure, timed
from vla.jobs.benchmark.rendering import renderings
from vla.parallel.limits import cores
from vla.parallel.pool import LocalCluster
from vla.parallel.processes import WorkerFactory
from vla.rollouts.collect import DemonstrationWorker
from vla.rollouts.rollout import replay, rollout
from vla.spec import Agent, Environment, Episode


def measures(experiment: Experiment) -> dict[str, Measure]:
    """Measure control steps per second.

    - collect: rollouts of one process with all cameras; the floor is physics and rendering, with `minimal_step`.
    - breakdown of the time of a step, including replay and storage; the floor is the whole step.
    - the images of a step by each renderer; the floor is the fastest.
    - all processes, including verification; the floor is that of one process times their number.
    - robosuite on the same work as the floor, if `benchmark.robosuite` names a Python interpreter.
    """
    asked = experiment.options(Benchmark)
    makers = experiment.make_environment(), experiment.make_expert()
    environment = makers[0]()
    expert = makers[1](environment)
    rollout(environment, expert, 0)  # warm-up: compiles shaders
    calls = environment.minimal_step() if isinstance(environment, HasMinimalStep) else {}
    episodes, taken = _timed_parts(environment, expert, calls, asked.episodes)
    steps = sum(len(episode.actions) for episode in episodes)
    floor, full, blind = {name: taken[name] for name in calls}, taken["full"], taken["blind"]
    with TemporaryDirectory() as folder:
        store = EpisodeStore.create_or_open(folder, environment.spec, {})
        with store.writing():
            _, storing = timed(partial(_keep, store, episodes))
    environment.close()
    physics, rendering = floor.get("physics", 0.0), floor.get("rendering", 0.0)
    stages = {
        **floor,
        "expert, controller, judge": blind - physics,
        "images into arrays": full - blind - rendering,
        "replay": taken["replay"],
        "storing": storing,
    }
    least = steps / sum(floor.values()) if floor else None
    found = {"collect": measure(steps / full, "control steps/s", steps, least)}
    whole = 1000 * (full + taken["replay"] + storing) / steps
    for name, seconds in stages.items():
        found[f"collect: {name}"] = measure(1000 * seconds / steps, "ms/step", steps, whole)
    found |= renderings(experiment)
    work = partial(DemonstrationWorker, *makers)
    alone, together = (_attempts(work, count, asked.episodes) for count in (1, cores()))
    found[f"collect: {cores()} processes"] = measure(*together, cores() * alone[0])
    if asked.robosuite is not None:
        arguments = (*environment.spec.image_size, DURATION)
        for count, (rate, unit, n) in ((1, alone), (cores(), together)):
            rival = peer("robosuite", asked.robosuite, "robosuite_lift.py", arguments, count)
            if count == 1:  # robosuite verifies nothing: the same work is a rollout without verification
                found["collect, against robosuite"] = measure(steps / full, unit, steps, rival)
            found[f"collect: verified, against {count} of robosuite"] = measure(rate, unit, n, rival)
    return found


def _timed_parts(
    environment: Environment, expert: Agent, calls: Mapping[str, Callable[[], object]], count: int
) -> tuple[list[Episode], dict[str, float]]:
    """Return episodes, and the time [s] of: "full" rollouts, "blind" ones, "replay", and each call in every state.

    The parts of one episode follow each other, so that what else runs on the machine slows all parts alike.
    """
    episodes: list[Episode] = []
    taken = dict.fromkeys(("full", "blind", "replay", *calls), 0.0)
    for seed in range(count):
        episode, seconds = timed(partial(rollout, environment, expert, seed))
        episodes.append(episode)
        taken["full"] += seconds
        environment.reset(seed)
        with environment.blind():
            for action in episode.executed:
                for name, call in calls.items():
                    taken[name] += timed(call)[1]
                environment.step(action)
            taken["blind"] += timed(partial(rollout, environment, expert, seed))[1]
            taken["replay"] += timed(partial(replay, environment, episode))[1]
    return episodes, taken


def _keep(store: EpisodeStore, episodes: list[Episode]) -> None:
    for episode in episodes:
        if episode.success:
            store.append(episode)
        else:
            store.fail(episode)


def _attempts(make: WorkerFactory, processes: int, episodes_each: int) -> tuple[float, str, int]:
    """Return the rate of verified control steps of concurrent processes after a warm-up, its unit, and their number."""
    with LocalCluster(processes, "beside").pool(make) as pool:
        for attempt in [pool.submit(seed) for seed in range(2 * processes)]:
            attempt.result()
        seeds = range(processes * episodes_each)
        episodes, seconds = timed(lambda: [attempt.result() for attempt in [pool.submit(seed) for seed in seeds]])
    steps = sum(len(episode.actions) for episode in episodes)
    return steps / seconds, "control steps/s", steps
