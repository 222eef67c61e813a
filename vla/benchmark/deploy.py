"""The times that matter on a robot."""

from __future__ import annotations

import numpy as np
from omegaconf import DictConfig

from vla.benchmark.measure import Measure, measure


def measures(config: DictConfig) -> dict[str, Measure]:
    """The deployed loop over ROS 2 between processes, in real time: three measures.

    From taking an image to the command that follows, at the median, against inference alone; the time between commands
    at the 99th percentile, against what it should be; from a frozen simulator to a holding agent, at the median,
    against the age at which a joint state counts as lost.

    Raises:
        ValueError: no loop or no checkpoint is chosen.
    """
    from vla.jobs import deployed

    if not config.deploy or config.deploy._target_ != "vla.deploy.loop.Loop":
        raise ValueError("benchmark.names=[deploy] needs deploy=loop checkpoint=FILE")
    loop = deployed(config)
    with loop.playing() as person:
        for _ in range(loop.episodes):
            person.play()
        person.begin()
        reactions = [1000 * person.react() for _ in range(config.benchmark.episodes)]
        figures = {key: float(value) for key, value in person.status.items() if key.endswith("[ms]")}
    agent = config.deploy.agent
    image, inference = (figures[f"{name} p50 [ms]"] for name in ("image to command", "inference"))
    return {
        "deploy: image to command": measure(image, "ms", loop.episodes, inference),
        "deploy: tick p99": measure(figures["tick p99 [ms]"], "ms", loop.episodes, 1000 / agent.command_hz),
        "deploy: watchdog": measure(float(np.median(reactions)), "ms", len(reactions), 1000 * agent.safety.joints_age),
    }
