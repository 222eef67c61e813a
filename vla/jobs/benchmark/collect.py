"""Throughput of collection and its breakdown, and the renderers of a task."""

from __future__ import annotations

from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

from vla.config.annotations import locate
from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.config.packages import CONF
from vla.data.episodes import EpisodeStore
from vla.io.documents import read_yaml
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.parallel.limits import cores
from vla.parallel.pool import Cluster
from vla.parallel.processes import WorkerFactory
from vla.rollouts.collect import DemonstrationWorker
from vla.rollouts.rollout import replay, rollout
from vla.spec import Agent, Environment, Episode

FRAMES = 10  # that a renderer draws before it is the turn of the next one


def collect(experiment: Experiment) -> dict[str, Measure]:
    """Measure control steps per second of one process with all cameras; the floor is physics and rendering alone.

    Also measure the parts of a step (floor: the whole step), the rendering of its images by each renderer (floor: the
    fastest), and all processes together (floor: one process, times their number). A world that can run the unavoidable
    part of a step by itself has `minimal_step()`, which returns "physics" and "rendering" → a function that does it.
    """
    count, unit = experiment.options(Benchmark).episodes, "control steps/s"
    makers = experiment.make_environment(), experiment.make_expert()
    environment = makers[0]()
    expert = makers[1](environment)
    rollout(environment, expert, 0)  # warm-up: compiles shaders
    episodes, taken = _timed_parts(environment, expert, count)
    steps = sum(len(episode.actions) for episode in episodes)
    with TemporaryDirectory() as folder:
        store = EpisodeStore.create_or_open(folder, environment.spec, {})
        with store.writing():
            taken["storing"] = timed(partial(_keep, store, episodes))[1]
    environment.close()
    full, blind = taken.pop("full"), taken.pop("blind")
    physics, rendering = taken.get("physics", 0.0), taken.get("rendering", 0.0)
    floor = steps / (physics + rendering) if physics else None
    found = {"collect": measure(steps / full, unit, steps, floor)}
    whole = 1000 * (full + taken["replay"] + taken["storing"]) / steps
    taken |= {"expert, controller, judge": blind - physics, "images into arrays": full - blind - rendering}
    for name, seconds in taken.items():
        found[f"collect: {name}"] = measure(1000 * seconds / steps, "ms/step", steps, whole)
    found |= _renderers(experiment)
    work = partial(DemonstrationWorker, *makers)
    alone, together = (_verified(work, processes, count) for processes in (1, cores()))
    found[f"collect: {cores()} processes"] = measure(together, unit, steps, cores() * alone)
    return found


def _timed_parts(environment: Environment, expert: Agent, count: int) -> tuple[list[Episode], dict[str, float]]:
    """Return episodes, and the time [s] of "full" rollouts, "blind" ones, "replay", and each call of `minimal_step`.

    The parts are timed in turns, episode by episode, so that other load on the machine slows all of them alike.
    """
    calls = getattr(environment, "minimal_step", dict)()
    episodes, taken = list[Episode](), dict.fromkeys((*calls, "full", "blind", "replay"), 0.0)
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
        (store.append if episode.success else store.fail)(episode)


def _renderers(experiment: Experiment) -> dict[str, Measure]:
    """Measure the rendering of a step by every renderer of the task in turns; "chosen" is one with custom settings."""
    own, choice = experiment["task"].get("renderer"), _options()
    if own is None or own["_target_"] not in [node["_target_"] for node in choice.values()]:
        return {}
    nodes = choice if own in choice.values() else {**choice, "chosen": own}
    worlds: dict[str, Any] = {name: experiment.make_environment({"renderer": each})() for name, each in nodes.items()}
    seconds, rounds = dict.fromkeys(worlds, 0.0), experiment.options(Benchmark).episodes
    for seed in range(rounds):
        for name, world in worlds.items():
            world.reset(seed)
            draw = world.minimal_step()["rendering"]
            seconds[name] += timed(lambda draw=draw: [draw() for _ in range(FRAMES)])[1]
    for world in worlds.values():
        world.close()
    times = {f"collect: rendering, {name}": 1000 * each / FRAMES / rounds for name, each in seconds.items()}
    return {name: measure(each, "ms/step", FRAMES * rounds, min(times.values())) for name, each in times.items()}


def _options() -> dict[str, Any]:
    """Return the renderers that this machine can use."""
    found = {}
    for file in sorted((CONF / "task/renderer").glob("*.yaml")):
        node = read_yaml(file, dict[str, Any])
        kind: Any = locate("task.renderer._target_", node["_target_"])
        if not getattr(kind, "substitute", lambda: None)():
            found[file.stem] = node
    return found


def _verified(make: WorkerFactory, processes: int, episodes_each: int) -> float:
    """Return the rate of verified control steps [1/s] of concurrent processes after a warm-up."""
    with Cluster(processes, "beside").pool(make) as pool:
        play = lambda seeds: [attempt.result() for attempt in [pool.submit(seed) for seed in seeds]]  # noqa: E731
        play(range(2 * processes))
        episodes, seconds = timed(partial(play, range(processes * episodes_each)))
    return sum(len(episode.actions) for episode in episodes) / seconds
