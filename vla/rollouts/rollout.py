"""Rollout of a single episode by an agent in an environment, and its replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vla.rollouts.worlds import Stage, as_agents, copy_observation, play
from vla.spec import Agent, Environment, Episode, Observation, Recorder

EnvironmentFactory = Callable[[], Environment]
AgentFactory = Callable[[Environment], Agent]


def rollout(
    environment: Environment, agent: Agent, seed: int, recorder: Recorder | None = None, all_images: bool = True
) -> Episode:
    """Run the episode of `seed` to its end: `vla.rollouts.worlds.play` in one world.

    Raises a UserError if an action has the wrong shape or is not finite, or the episode is over at its start.
    """
    ((_, result),) = play([Stage(environment, recorder)], as_agents(agent), [seed], all_images)
    if isinstance(result, Exception):
        raise result
    return result


class Replay(NamedTuple):
    """Result of a replay."""

    observations: list[Observation]
    # First step with another state; number of replayed steps if only the end differs; None: equal.
    first_difference: int | None


def replay(environment: Environment, episode: Episode, recorder: Recorder | None = None) -> Replay:
    """Execute the actions of an episode again from its seed; record this world with the observations of the episode."""
    observation = environment.reset(episode.seed)
    if recorder is not None:
        recorder.start(environment)
    matches, observations = [], []
    for reference, action in zip(episode.observations, episode.executed, strict=True):
        if environment.done:
            break
        observations.append(copy_observation(observation))
        matches.append(np.array_equal(observations[-1].state, reference.state))
        if recorder is not None:
            recorder.step(reference, action, {})
        observation = environment.step(action)
    if recorder is not None:
        recorder.end(episode)
    if not all(matches):
        return Replay(observations, matches.index(False))
    same_end = len(matches) == len(episode.executed) and environment.done and environment.outcome == episode.outcome
    return Replay(observations, None if same_end else len(matches))


def close_agent(agent: Agent) -> None:
    """Close what an agent holds, such as a connection or a thread; most agents hold nothing and have no `close`."""
    if callable(close := getattr(agent, "close", None)):
        close()
