"""Early stopping beside STEP, for the table in docs/results/deciding.md: `python tests/step.py`, where
sequentialized-barnard-tests 0.0.9 is installed.

Two policies play up to 500 episodes, on different seeds or on the same ones; on the same, four of five episodes are
decided by how hard the scene is, for both alike. STEP has only a policy with 5 % for a false difference in each
direction, 10 % in all, so bets have 10 % once, and once the 5 % of `evaluate.until=decided`.
"""

from __future__ import annotations

from math import log
from typing import Any

import numpy as np

from vla.rollouts.sequential import LEVEL, log_capital
from vla.spec import Array

EPISODES = 500
SIMULATIONS = 1000
ALIKE = 0.8  # share of the episodes on the same seeds that their scene decides
ROWS = ((0.8, 0.8, 0.0), (0.7, 0.8, 0.0), (0.8, 0.9, 0.0), (0.85, 0.95, 0.0), (0.85, 0.95, ALIKE), (0.9, 0.98, ALIKE))


def outcomes(one: float, other: float, alike: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Successes (SIMULATIONS, EPISODES) of two policies with these rates."""
    shape = (SIMULATIONS, EPISODES)
    first, second = random.random(shape), random.random(shape)
    second = np.where(random.random(shape) < alike, first, second)
    return first < one, second < other


def after_bets(first: Array, second: Array, level: float) -> list[int]:
    """Numbers of episodes after which bets find a difference; 0: never."""
    lost, won = (np.cumsum(each, axis=1) for each in (first & ~second, second & ~first))
    least = [_least(number, level) for number in range(EPISODES + 1)]  # of the larger number, given the smaller one
    decided = np.maximum(lost, won) >= np.array(least)[np.minimum(lost, won)]
    return [int(row.argmax()) + 1 if row.any() else 0 for row in decided]


def _least(smaller: int, level: float) -> int:
    larger = np.arange(smaller, EPISODES + 1)
    return smaller + int(np.searchsorted(log_capital(0.5, larger, smaller), log(1 / level)))


def after_step(test: Any, first: Array, second: Array) -> list[int]:
    """The same for STEP."""
    from sequentialized_barnard_tests import Decision

    found = []
    for row, other in zip(first, second, strict=True):
        test.reset()
        decisions = (test.step(int(a), int(b)).decision for a, b in zip(row, other, strict=True))
        found.append(next((number for number, each in enumerate(decisions, 1) if each != Decision.FailToDecide), 0))
    return found


def described(ends: list[int]) -> str:
    """The share that was decided, and the mean number of episodes."""
    played = [end or EPISODES for end in ends]
    return f"{sum(map(bool, ends)) / len(ends):6.1%} after {np.mean(played):3.0f}"


def main() -> None:
    from sequentialized_barnard_tests import Hypothesis, MirroredStepTest

    step = MirroredStepTest(Hypothesis.P0LessThanP1, EPISODES, LEVEL)
    for one, other, alike in ROWS:
        first, second = outcomes(one, other, alike, np.random.default_rng(0))
        bets = [described(after_bets(first, second, level)) for level in (2 * LEVEL, LEVEL)]
        episodes = "the same" if alike else "different"
        print(f"{one:.0%} and {other:.0%}, {episodes}: STEP {described(after_step(step, first, second))}", end="")
        print(f", bets with 10 % {bets[0]}, with 5 % {bets[1]}", flush=True)


if __name__ == "__main__":
    main()
