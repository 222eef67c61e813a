"""Latencies of a deployed policy."""

from __future__ import annotations

import numpy as np

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.io.documents import parse_json
from vla.io.errors import UserError
from vla.jobs.benchmark.measure import Measure, measure
from vla.jobs.deploy import deployment


def measures(experiment: Experiment) -> dict[str, Measure]:
    """Measure the closed loop over ROS 2, with the nodes in processes of their own, in real time.

    - image to command: median latency from the exposure of an image to the next command; the floor is inference alone.
    - tick p99: 99th percentile of the period of the commands; the floor is the nominal period.
    - watchdog: median delay from a frozen simulator to a held arm; the floor is the maximum age of a joint state.

    Raises:
        UserError: no loop or no checkpoint is chosen.
    """
    node = experiment["deploy"]
    if not node or node["_target_"] != "vla.deploy.loop.Loop":
        raise UserError("benchmark.names=[deploy] needs deploy=loop checkpoint=RUN")
    loop = deployment(experiment)
    with loop.running() as operator:
        for _ in range(loop.episodes):
            operator.play()
        operator.begin_episode()
        delays = [1000 * operator.watchdog_delay() for _ in range(experiment.options(Benchmark).episodes)]
        keys = ("image to command p50 [ms]", "inference p50 [ms]", "tick p99 [ms]")
        image, inference, tick = (
            parse_json(operator.status.get(key, ""), float, f"{key} of /vla_agent/status") for key in keys
        )
    agent = node["agent"]
    return {
        "deploy: image to command": measure(image, "ms", loop.episodes, inference),
        "deploy: tick p99": measure(tick, "ms", loop.episodes, 1000 / agent["command_hz"]),
        "deploy: watchdog": measure(float(np.median(delays)), "ms", len(delays), 1000 * agent["safety"]["joints_age"]),
    }
