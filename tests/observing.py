"""Observations of the toy world, and what a policy does with them."""

from __future__ import annotations

import numpy as np
from toy import ToyEnvironment

from vla.policy import Policy
from vla.spec import Observation


def observations(count: int, seed: int = 0) -> list[Observation]:
    environment = ToyEnvironment()
    seen = [environment.reset(seed)]
    while len(seen) < count:
        seen.append(environment.step(np.array([0.02, -0.01, 1.0])))
    return seen


def act(policy: Policy, seen: list[Observation]) -> np.ndarray:
    return np.stack([policy.act(observation) for observation in seen])
