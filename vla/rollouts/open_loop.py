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
from vla.io.errors import UserError
from vla.rollouts.statistics import mean_interval
from vla.spec import Agent, Array, Episode, Spec


@dataclass(frozen=True)
class OpenLoop:
    """Recorded and predicted actions of several episodes, and mean absolute errors.

    Means give all recordings equal weight, and intervals are over recordings: neither the steps of an episode nor the
    episodes that one recording was split into are independent.
    """

    spec: Spec
    seeds: list[int]
    recorded: list[Array]  # E times (N, D)
    predicted: list[Array]  # E times (N, D)
    errors: Array  # (E, D) of the episodes
    mean: Array  # (D,)
    interval: tuple[Array, Array]  # (D,) each: 95 % confidence interval of the mean
    constant_errors: Array  # (D,) of the mean action of the training episodes, which predicts without looking

    @property
    def scale(self) -> Array:
        """(D,) errors of the constant prediction, at least a thousandth of a component's range."""
        return np.maximum(self.constant_errors, 1e-3 * (np.array(self.spec.high) - np.array(self.spec.low)))

    @property
    def relative(self) -> float:
        """Mean over the components of the error as a fraction of the constant prediction's."""
        return float((self.mean / self.scale).mean())


def open_loop(agent: Agent, spec: Spec, episodes: Iterable[Episode], constant: Array) -> OpenLoop:
    """Show recorded episodes to an agent, observation by observation, and measure what it would do.

    `constant` is the (D,) mean action of the training episodes.
    """
    seeds, recordings, recorded, predicted = list[int](), [], list[Array](), list[Array]()
    for episode in episodes:
        agent.reset(episode.instruction, episode.seed)
        predicted.append(np.stack([agent.act(observation) for observation in episode.observations]))
        if predicted[-1].shape[1:] != (len(spec.action),) or not np.isfinite(predicted[-1]).all():
            raise UserError(f"the agent's actions must be {len(spec.action)} finite numbers, as in the spec")
        recorded.append(episode.actions)
        seeds.append(episode.seed)
        recordings.append(recording_of(episode))

    def by_recording(errors: Array) -> Array:
        """Return the (R, D) means of (E, D) errors over the episodes of every recording."""
        numbers = np.array(recordings)
        return np.array([errors[numbers == recording].mean(0) for recording in dict.fromkeys(recordings)])

    errors = np.array([np.abs(output - label).mean(0) for output, label in zip(predicted, recorded, strict=True)])
    means, constants = by_recording(errors), np.array([np.abs(actions - constant).mean(0) for actions in recorded])
    interval, constant_errors = mean_interval(means), by_recording(constants).mean(0)
    return OpenLoop(spec, seeds, recorded, predicted, errors, means.mean(0), interval, constant_errors)
