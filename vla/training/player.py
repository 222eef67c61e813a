"""The worker that plays episodes during training.

Its processes import this module, which is why it imports no Lightning: that takes several seconds in each of them.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing

from vla.models.model import Model
from vla.rollouts.evaluate import play_episodes
from vla.rollouts.results import Result
from vla.spec import Agent, Environment


class Player:
    """Worker that plays episodes with a copy of a model, and keeps environments only while it plays."""

    def __init__(self, make_environment: Callable[[], Environment], make_policy: Callable[[Model], Agent]) -> None:
        self._make_environment, self._make_policy = make_environment, make_policy

    def attempt(self, item: tuple[bytes, Sequence[int]]) -> list[Result]:
        """Play the episodes of seeds with a pickled model."""
        return self.play(pickle.loads(item[0]), item[1])

    def play(self, model: Model, seeds: Sequence[int]) -> list[Result]:
        """Play the episodes of seeds with a model, in as many worlds side by side as its policy has lanes."""
        policy = self._make_policy(model)
        lanes = min(getattr(policy, "lanes", 1), len(seeds))
        with ExitStack() as stack:
            environments = [stack.enter_context(closing(self._make_environment())) for _ in range(lanes)]
            return play_episodes(environments, policy, seeds)

    def close(self) -> None:
        """Do nothing: there are no resources to free."""
