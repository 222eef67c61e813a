"""Speed of a policy: of an action, an evaluation, over a network on this machine, and deployed over ROS 2."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from vla.config.build import build
from vla.config.compose import compose
from vla.config.experiment import Experiment, plain
from vla.config.nodes import Benchmark
from vla.io.documents import parse_json
from vla.io.errors import UserError
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.jobs.collect import demonstrations
from vla.jobs.deploy import deployment


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


def deploy(experiment: Experiment) -> dict[str, Measure]:
    """Measure the closed loop over ROS 2, with the nodes in processes of their own, in real time.

    Median latency from the exposure of an image to the next command, beside inference alone; 99th percentile of the
    period of commands, beside the nominal one; median delay from a frozen simulator to a held arm, beside the largest
    age of a joint state. Raises a UserError if no loop or no checkpoint is chosen.
    """
    if not experiment["deploy"] or experiment["deploy"]["_target_"] != "vla.deploy.loop.Loop":
        raise UserError("benchmark.names=[deploy] needs deploy=loop checkpoint=RUN")
    loop = deployment(experiment)
    with loop.running() as operator:
        for _ in range(loop.episodes):
            operator.play()
        operator.begin_episode()
        delays = [1000 * operator.watchdog_delay() for _ in range(experiment.options(Benchmark).episodes)]
        image, inference, tick = (
            parse_json(operator.values.get(key, ""), float, f"{key} of /vla_agent/status")
            for key in ("image to command p50 [ms]", "inference p50 [ms]", "tick p99 [ms]")
        )
    agent = experiment["deploy"]["agent"]
    return {
        "deploy: image to command": measure(image, "ms", loop.episodes, inference),
        "deploy: tick p99": measure(tick, "ms", loop.episodes, 1000 / agent["command_hz"]),
        "deploy: watchdog": measure(float(np.median(delays)), "ms", len(delays), 1000 * agent["safety"]["joints_age"]),
    }


def serve(experiment: Experiment) -> dict[str, Measure]:
    """Measure round trips through the loopback interface, beside the policy called in its own process, in turns."""
    from vla.deploy.server import Service

    served, steps = experiment.make_policy()(), experiment.options(Benchmark).steps
    images = {camera: f"observation.images.{camera}" for camera in served.spec.cameras}
    composed = compose("deploy=server", "agent=remote", "deploy.port=0", f"deploy.largest_message={2**26}")
    server, client = plain(composed.deploy), plain(composed.agent)
    server["keys"] |= {"images": images, "state": ["observation.state"]}
    settings = build(server, "deploy", policy=None, environment=experiment.make_environment(), output=Path())
    random, times = np.random.default_rng(0), []
    with Service(settings, served).in_thread() as url:
        changes = {"url": url, "images": images, "state": {"observation.state": None}}
        agent: Any = build(client | changes, "agent", spec=served.spec)
        for observation in [served.spec.random_observation(random) for _ in range(steps)]:
            plan = timed(partial(served.plan, [observation], [1]))[1]
            times.append((timed(partial(agent.ask, observation))[1], plan))
        agent.close()
    (trip, plan), (slow_trip, slow_plan) = (1000 * np.percentile(times, [50, 99], axis=0)).tolist()
    return {
        "serve": measure(trip, "ms", steps, plan),
        "serve: 99th percentile": measure(slow_trip, "ms", steps, slow_plan),
    }
