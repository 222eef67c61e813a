"""Open-loop evaluation: errors of the actions that a policy predicts along recorded episodes.

What the policy predicts has no effect: the next observation is the recorded one. Small errors therefore do not imply
success, nor do large ones exclude it.

Shapes: E episodes, N steps of an episode, D action components.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vla.rollouts.statistics import mean_interval
from vla.spec import Agent, Array, Episode, Spec


@dataclass(frozen=True)
class OpenLoop:
    """Recorded and predicted actions of several episodes, in the order of their seeds.

    Every episode weighs alike in the means, and intervals are over episodes, because steps of one are correlated.
    """

    spec: Spec
    seeds: tuple[int, ...]
    recorded: tuple[Array, ...]  # E times (N, D)
    predicted: tuple[Array, ...]  # E times (N, D)
    constant: Array  # (D,) mean action of the training episodes, which predicts without looking

    @property
    def errors(self) -> Array:
        """(E, D) mean absolute errors of the episodes."""
        return np.array(
            [np.abs(ours - theirs).mean(0) for ours, theirs in zip(self.predicted, self.recorded, strict=True)]
        )

    @property
    def constant_errors(self) -> Array:
        """(D,) mean absolute errors of the constant prediction."""
        return np.array([np.abs(actions - self.constant).mean(0) for actions in self.recorded]).mean(0)

    @property
    def interval(self) -> tuple[Array, Array]:
        """95 % confidence intervals of the mean errors, two arrays (D,)."""
        return mean_interval(self.errors)

    @property
    def scale(self) -> Array:
        """(D,) errors of the constant prediction, at least a thousandth of a component's range."""
        return np.maximum(self.constant_errors, 1e-3 * (np.array(self.spec.high) - np.array(self.spec.low)))

    @property
    def relative(self) -> float:
        """Mean over the components of the error as a fraction of the constant prediction's."""
        return float((self.errors.mean(0) / self.scale).mean())


def open_loop(agent: Agent, spec: Spec, episodes: Iterable[Episode], constant: Array) -> OpenLoop:
    """Show recorded episodes to an agent, observation by observation, and collect what it would do."""
    seeds, recorded, predicted = [], [], []
    for episode in episodes:
        agent.reset(episode.instruction, episode.seed)
        predicted.append(np.stack([agent.act(observation) for observation in episode.observations]))
        recorded.append(episode.actions)
        seeds.append(episode.seed)
    return OpenLoop(spec, tuple(seeds), tuple(recorded), tuple(predicted), constant)
