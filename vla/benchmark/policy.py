"""The time that an action takes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from omegaconf import DictConfig

from vla.benchmark.measure import Measure, measure, timed
from vla.check import build


def measures(config: DictConfig) -> dict[str, Measure]:
    """The time from an observation to an action, as `config.policy` computes it, against its network alone, in 32 bits
    and uncompiled; and of that network if it encoded every frame of its history anew, against that time."""
    import torch

    from vla.parts import collected, make_environment, make_learner, plain

    environment = make_environment(plain(config.task))
    observation = environment.reset(0)
    environment.close()
    model = make_learner(config, collected(config)).model
    agent = build(config.policy, "policy", model=model, spec=environment.spec)
    for _ in range(model.history + 1):  # the first ones compile and allocate
        agent.act(observation)
    frame = agent.frame(observation)
    rgb = {camera: images.expand(1, model.history, -1, -1, -1) for camera, images in frame["rgb"].items()}
    frames = {name: frame[name].expand(1, model.history, *frame[name].shape[2:]) for name in ("proprio", "present")}
    whole = {"rgb": rgb, "text": frame["text"], **frames}
    steps = config.benchmark.steps
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
    """Median time [ms] that `work` takes."""
    return 1000 * float(np.median([timed(work)[1] for _ in range(rounds)]))
