"""The renderers of a task beside each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

from vla.config.annotations import locate
from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.config.packages import CONF
from vla.io.documents import read_yaml
from vla.jobs.benchmark.measure import HasMinimalStep, Measure, measure, timed

FRAMES = 10  # of a renderer before it is the next one's turn


def renderings(experiment: Experiment) -> dict[str, Measure]:
    """Measure the time of a step's images by every renderer, in turns and on the same scenes.

    The floor is the fastest one. A renderer with settings of the user's is "chosen", beside the others. Nothing is
    measured of a world without `minimal_step` or such a renderer.
    """
    own, choice = experiment.task.get("renderer"), _options()
    if own is None or own["_target_"] not in [node["_target_"] for node in choice.values()]:
        return {}
    nodes = choice if own in choice.values() else {**choice, "chosen": own}
    worlds = {name: experiment.make_environment({"renderer": node})() for name, node in nodes.items()}
    seconds: defaultdict[str, float] = defaultdict(float)
    rounds = experiment.options(Benchmark).episodes
    for seed in range(rounds):
        for name, world in worlds.items():
            if isinstance(world, HasMinimalStep):
                world.reset(seed)
                seconds[name] += timed(partial(_draw, world.minimal_step()["rendering"]))[1]
    for world in worlds.values():
        world.close()
    steps = FRAMES * rounds
    times = {f"collect: rendering, {name}": 1000 * total / steps for name, total in seconds.items()}
    return {name: measure(each, "ms/step", steps, min(times.values())) for name, each in times.items()}


def _options() -> dict[str, Any]:
    """Return the renderers that this machine can use."""
    found = {}
    for file in sorted((CONF / "task/renderer").glob("*.yaml")):
        node = read_yaml(file, dict[str, Any])
        kind: Any = locate("task.renderer._target_", node["_target_"])
        if not getattr(kind, "substitute", lambda: None)():
            found[file.stem] = node
    return found


def _draw(draw: Callable[[], object]) -> None:
    for _ in range(FRAMES):
        draw()
