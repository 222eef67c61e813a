"""Open-loop evaluation: errors of the actions that a policy predicts along recorded episodes.

What the policy predicts has no effect: the next observation is the recorded one. Small errors therefore do not imply
success, nor do large ones exclude it.

Shapes: E episodes, R recordings, N steps of an episode, D action components.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vla.data.index import recording_of
from vla.rollouts.statistics import mean_interval
from vla.spec import Agent, Array, Episode, Spec


@dataclass(frozen=True)
class OpenLoop:
    """Recorded and predicted actions of several episodes, in the order of their seeds.

    Every recording weighs alike in the means, and intervals are over recordings: neither the steps of an episode nor
    the episodes that one recording was split into are independent.
    """

    spec: Spec
    seeds: tuple[int, ...]
    recordings: tuple[int, ...]  # E, see `vla.data.index.recording_of`
    recorded: tuple[Array, ...]  # E times (N, D)
    predicted: tuple[Array, ...]  # E times (N, D)
    constant: Array  # (D,) mean action of the training episodes, which predicts without looking

    @property
    def errors(self) -> Array:
        """(E, D) mean absolute errors of the episodes."""
        pairs = zip(self.predicted, self.recorded, strict=True)
        return np.array([np.abs(predicted - recorded).mean(0) for predicted, recorded in pairs])

    @property
    def mean(self) -> Array:
        """(D,) mean absolute errors."""
        return self._by_recording(self.errors).mean(0)

    @property
    def interval(self) -> tuple[Array, Array]:
        """95 % confidence intervals of the mean errors, two arrays (D,)."""
        return mean_interval(self._by_recording(self.errors))

    @property
    def constant_errors(self) -> Array:
        """(D,) mean absolute errors of the constant prediction."""
        errors = np.array([np.abs(actions - self.constant).mean(0) for actions in self.recorded])
        return self._by_recording(errors).mean(0)

    @property
    def scale(self) -> Array:
        """(D,) errors of the constant prediction, at least a thousandth of a component's range."""
        return np.maximum(self.constant_errors, 1e-3 * (np.array(self.spec.high) - np.array(self.spec.low)))

    @property
    def relative(self) -> float:
        """Mean over the components of the error as a fraction of the constant prediction's."""
        return float((self.mean / self.scale).mean())

    def _by_recording(self, errors: Array) -> Array:
        """Return the (R, D) means of (E, D) errors over the episodes of every recording."""
        recordings = np.array(self.recordings)
        return np.array([errors[recordings == each].mean(0) for each in dict.fromkeys(self.recordings)])


def open_loop(agent: Agent, spec: Spec, episodes: Iterable[Episode], constant: Array) -> OpenLoop:
    """Show recorded episodes to an agent, observation by observation, and collect what it would do."""
    seeds, recordings, recorded, predicted = [], [], [], []
    for episode in episodes:
        agent.reset(episode.instruction, episode.seed)
        predicted.append(np.stack([agent.act(observation) for observation in episode.observations]))
        recorded.append(episode.actions)
        seeds.append(episode.seed)
        recordings.append(recording_of(episode.seed, episode.draws))
    return OpenLoop(spec, tuple(seeds), tuple(recordings), tuple(recorded), tuple(predicted), constant)
