"""Speed of a policy, per plan and in an evaluation."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from vla.config.build import Group, build
from vla.config.compose import compose
from vla.config.experiment import Experiment, to_plain
from vla.config.nodes import Benchmark
from vla.data.verification import episode_of
from vla.io.errors import UserError
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.jobs.collect import demonstrations

PEER = Group("benchmark.peer", ("collections.abc.Callable",))
EQUAL = 1e-4  # largest difference of equal actions, relative to the largest one


def policy(experiment: Experiment) -> dict[str, Measure]:
    """Measure the median latency of a plan; the floor is the network alone, in float32 and not compiled.

    With `benchmark.peer`, the floor is the same plan by another implementation with equal weights.

    Raises:
        UserError: the peer plans other actions.
    """
    store = demonstrations(experiment)
    observation = episode_of(store, store.episodes[0]).observations[0]
    model = experiment.fitted_learner(store).model
    agent = experiment.build("policy", model=model, spec=store.spec)
    for _ in range(model.history + 1):  # warm-up: compiles and allocates
        agent.act(observation)
    frame = agent.frame(observation)
    options = experiment.options(Benchmark)
    with torch.inference_mode():
        window = agent.window()
        if options.peer:
            floor = partial(build({**options.peer, "_partial_": False}, PEER, model=model), window)
            _require_equal(floor(), model.predict(window).actions)
        else:

            def floor() -> object:
                return model.encode(frame), model.predict(window).actions.cpu()

        times = np.array([[timed(partial(agent.plan, observation))[1], timed(floor)[1]] for _ in range(options.steps)])
    latency, network = 1000 * np.median(times, 0)
    return {"policy": measure(latency, "ms", options.steps, network)}


def _require_equal(peer_actions: Tensor, actions: Tensor) -> None:
    difference = float((peer_actions - actions).abs().max() / peer_actions.abs().max())
    if not difference <= EQUAL:
        raise UserError(f"benchmark.peer plans other actions: they differ by {difference:.1e} of the largest")


def evaluate(experiment: Experiment) -> dict[str, Measure]:
    """Measure `job=evaluate` with every recording, in episodes per second; the floor is the same without recordings."""
    count, rates, default = experiment.options(Benchmark).episodes, [], compose()
    # Further conditions would play more episodes than are counted, and early stopping fewer.
    options = to_plain(default.evaluate) | {"seed": experiment.evaluate.seed, "episodes": count, "recordings": "all"}
    for recorder in (to_plain(default.recorder), None):
        with TemporaryDirectory() as folder:
            values = {"job": "evaluate", "evaluate": options, "recorder": recorder, "output": folder}
            trial = experiment.with_values(values)
            rates.append(count / timed(partial(import_module("vla.jobs.evaluate").run, trial))[1])
    return {"evaluate": measure(rates[0], "episodes/s", count, rates[1])}
