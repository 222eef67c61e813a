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
    episodes, times = _time_parts(environment, expert, count)
    steps = sum(len(episode.actions) for episode in episodes)
    with TemporaryDirectory() as folder:
        store = EpisodeStore.create_or_open(folder, environment.spec, {})
        with store.writing():
            times["storing"] = timed(partial(_keep, store, episodes))[1]
    environment.close()
    full, blind = times.pop("full"), times.pop("blind", None)
    physics, rendering = times.get("physics", 0.0), times.get("rendering", 0.0)
    floor = steps / (physics + rendering) if physics else None
    measures = {"collect": measure(steps / full, unit, steps, floor)}
    whole = 1000 * (full + times["replay"] + times["storing"]) / steps
    if blind is not None:
        times |= {"expert, controller, judge": blind - physics, "images into arrays": full - blind - rendering}
    for name, seconds in times.items():
        measures[f"collect: {name}"] = measure(1000 * seconds / steps, "ms/step", steps, whole)
    if "rendering" in times:
        measures |= _renderers(experiment)
    work = partial(DemonstrationWorker, *makers)
    (single_rate, _), (total_rate, steps) = (_verified_rate(work, processes, count) for processes in (1, cores()))
    measures[f"collect: {cores()} processes"] = measure(total_rate, unit, steps, cores() * single_rate)
    return measures


def _time_parts(environment: Environment, expert: Agent, count: int) -> tuple[list[Episode], dict[str, float]]:
    """Return episodes, and the time [s] of "full" rollouts, "blind" ones, "replay", and each call of `minimal_step`.

    There are no blind rollouts of an expert that looks at the images.
    The parts are timed in turns, episode by episode, so that other load on the machine slows all of them alike.
    """
    calls = getattr(environment, "minimal_step", dict)()
    kinds = ("full", "replay") if getattr(expert, "looks", True) else ("full", "blind", "replay")
    episodes, times = list[Episode](), dict.fromkeys((*calls, *kinds), 0.0)
    for seed in range(count):
        episode, seconds = timed(partial(rollout, environment, expert, seed))
        episodes.append(episode)
        times["full"] += seconds
        environment.reset(seed)
        with environment.blind():
            for action in episode.executed:
                for name, call in calls.items():
                    times[name] += timed(call)[1]
                environment.step(action)
            if "blind" in times:
                times["blind"] += timed(partial(rollout, environment, expert, seed))[1]
            times["replay"] += timed(partial(replay, environment, episode))[1]
    return episodes, times


def _keep(store: EpisodeStore, episodes: list[Episode]) -> None:
    for episode in episodes:
        (store.append if episode.success else store.fail)(episode)


def _renderers(experiment: Experiment) -> dict[str, Measure]:
    """Measure the rendering of a step by every renderer of a task with `minimal_step`, in turns.

    "chosen" is one with custom settings.
    """
    renderer, options = experiment["task"].get("renderer"), _options()
    if renderer is None or renderer["_target_"] not in [node["_target_"] for node in options.values()]:
        return {}
    nodes = options if renderer in options.values() else {**options, "chosen": renderer}
    worlds: dict[str, Any] = {name: experiment.make_environment({"renderer": node})() for name, node in nodes.items()}
    seconds, rounds = dict.fromkeys(worlds, 0.0), experiment.options(Benchmark).episodes
    for seed in range(rounds):
        for name, world in worlds.items():
            world.reset(seed)
            draw = world.minimal_step()["rendering"]
            seconds[name] += timed(lambda draw=draw: [draw() for _ in range(FRAMES)])[1]
    for world in worlds.values():
        world.close()
    times = {f"collect: rendering, {name}": 1000 * time / FRAMES / rounds for name, time in seconds.items()}
    return {name: measure(time, "ms/step", FRAMES * rounds, min(times.values())) for name, time in times.items()}


def _options() -> dict[str, Any]:
    """Return the renderers that this machine can use."""
    renderers = {}
    for file in sorted((CONF / "task/renderer").glob("*.yaml")):
        node = read_yaml(file, dict[str, Any])
        kind: Any = locate("task.renderer._target_", node["_target_"])
        if not getattr(kind, "substitute", lambda: None)():
            renderers[file.stem] = node
    return renderers


def _verified_rate(make: WorkerFactory, processes: int, episodes_each: int) -> tuple[float, int]:
    """Return the rate of verified control steps [1/s] of concurrent processes after a warm-up, and their number."""
    with Cluster(processes, "beside").pool(make) as pool:
        play = lambda seeds: [attempt.result() for attempt in [pool.submit(seed) for seed in seeds]]  # noqa: E731
        play(range(2 * processes))
        episodes, seconds = timed(partial(play, range(processes * episodes_each)))
    steps = sum(len(episode.actions) for episode in episodes)
    return steps / seconds, steps
