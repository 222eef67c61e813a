"""Speed of a policy: of an action, and of an evaluation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from tempfile import TemporaryDirectory

import numpy as np
import torch

from vla.config.compose import compose
from vla.config.experiment import Experiment, plain
from vla.config.nodes import Benchmark
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.jobs.collect import demonstrations


def policy(experiment: Experiment) -> dict[str, Measure]:
    """Measure the median latency of an action; the floor is the network alone, in float32 and not compiled."""
    environment = experiment.make_environment()()
    observation = environment.reset(0)
    environment.close()
    model = experiment.fitted_learner(demonstrations(experiment)).model
    agent = experiment.build("policy", model=model, spec=environment.spec)
    for _ in range(model.history + 1):  # warm-up: compiles and allocates
        agent.act(observation)
    frame = agent.frame(observation)
    steps = experiment.options(Benchmark).steps
    acting = _median(lambda: agent.plan(observation), steps)
    with torch.inference_mode():
        kept = agent.window()
        network = _median(lambda: (model.encode(frame), model.predict(kept).actions.cpu()), steps)
    return {"policy": measure(acting, "ms", steps, network)}


def _median(work: Callable[[], object], rounds: int) -> float:
    """Return the median duration of `work` [ms]."""
    return 1000 * float(np.median([timed(work)[1] for _ in range(rounds)]))


def evaluate(experiment: Experiment) -> dict[str, Measure]:
    """Measure `job=evaluate` with every recording, in episodes per second; the floor is the same without recordings."""
    count, rates = experiment.options(Benchmark).episodes, []
    for recorder in (plain(compose().recorder), None):
        with TemporaryDirectory() as folder:
            asked = {"job": "evaluate", "evaluate.episodes": count, "evaluate.recordings": "all"}
            trial = experiment.with_values({**asked, "recorder": recorder, "output": folder})
            rates.append(count / timed(partial(import_module("vla.jobs.evaluate").run, trial))[1])
    return {"evaluate": measure(rates[0], "episodes/s", count, rates[1])}
