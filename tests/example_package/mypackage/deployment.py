"""A policy at work in the world that it was trained in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vla.io.types import Count
from vla.rollouts.evaluate import play_episode
from vla.rollouts.results import Report
from vla.spec import FIRST_SEED, Agent, Environment


@dataclass(kw_only=True)
class Rehearsal:
    """Plays episodes one after the other.

    Attributes:
        episodes: how many.
        policy, environment, output: given by the job.
    """

    episodes: Count
    policy: Callable[[], Agent]
    environment: Callable[[], Environment]
    output: Path

    def run(self) -> Report:
        """Play all episodes."""
        policy, environment = self.policy(), self.environment()
        seeds = range(FIRST_SEED, FIRST_SEED + self.episodes)
        return Report(tuple(play_episode(environment, policy, seed) for seed in seeds))
