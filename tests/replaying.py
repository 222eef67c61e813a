"""Episodes with random actions, and whether two of them are the same."""

from __future__ import annotations

import numpy as np

from vla.spec import Environment, Observation


def played(environment: Environment, seed: int, steps: int) -> list[Observation]:
    """What is seen in the first steps of an episode with random actions."""
    random = np.random.default_rng(seed)
    seen = [environment.reset(seed)]
    for _ in range(steps):
        seen.append(environment.step(random.uniform(environment.spec.low, environment.spec.high)))
    return seen


def same(one: list[Observation], other: list[Observation]) -> bool:
    """Whether states, truth, pictures and depths are the same, bit for bit."""
    return all(
        np.array_equal(a.state, b.state)
        and a.rgb.keys() == b.rgb.keys()
        and all(np.array_equal(a.rgb[name], b.rgb[name]) for name in a.rgb)
        and a.depth.keys() == b.depth.keys()
        and all(np.array_equal(a.depth[name], b.depth[name]) for name in a.depth)
        and all(np.array_equal((a.truth or {})[name], (b.truth or {})[name]) for name in a.truth or {})
        for a, b in zip(one, other, strict=True)
    )
