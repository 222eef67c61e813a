"""Latency of an action."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.jobs.collect import demonstrations


def measures(experiment: Experiment) -> dict[str, Measure]:
    """Measure the median latency from an observation to an action.

    - policy: with the options of `policy`; the floor is the network alone, in float32 and not compiled.
    - every frame anew: the network if it encoded its whole history at every step; the floor is the latency above.
    """
    environment = experiment.make_environment()()
    observation = environment.reset(0)
    environment.close()
    model = experiment.fitted_learner(demonstrations(experiment)).model
    agent = experiment.build("policy", model=model, spec=environment.spec)
    for _ in range(model.history + 1):  # warm-up: compiles and allocates
        agent.act(observation)
    frame = agent.frame(observation)
    rgb = {camera: images.expand(1, model.history, -1, -1, -1) for camera, images in frame["rgb"].items()}
    frames = {name: frame[name].expand(1, model.history, *frame[name].shape[2:]) for name in ("state", "present")}
    whole = {"rgb": rgb, "text": frame["text"], **frames}
    steps = experiment.options(Benchmark).steps
    acting = _median(lambda: agent.plan(observation), steps)
    with torch.inference_mode():
        kept = agent.window()
        network = _median(lambda: (model.encode(frame), model.predict(kept).actions.cpu()), steps)
        naive = _median(lambda: model.predict(whole).actions.cpu(), steps)
    return {
        "policy": measure(acting, "ms", steps, network),
        "policy: every frame anew": measure(naive, "ms", steps, acting),
    }


def _median(work: Callable[[], object], rounds: int) -> float:
    """Return the median duration of `work` [ms]."""
    return 1000 * float(np.median([timed(work)[1] for _ in range(rounds)]))
