"""The agent-environment loop, and the replay of its episodes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vla.spec import Agent, Environment, Episode, InARow, Looking, Observation, Recorder, Traceable

EnvironmentFactory = Callable[[], Environment]
AgentFactory = Callable[[Environment], Agent]


def rollout(
    environment: Environment, agent: Agent, seed: int, recorder: Recorder | None = None, all_images: bool = True
) -> Episode:
    """Run the episode of `seed` to its end.

    Without `all_images`, images are rendered only at steps where the agent reads them. If a new instruction makes the
    agent read an image that was not rendered, the episode is run again with all images.

    The label for imitation is `agent.info["clean"]` if present, else the executed action. What the agent drew,
    `agent.info["draws"]`, is added to the draws of the environment. A new instruction resets the agent.

    Raises:
        ValueError: the agent returned an action of the wrong shape, or one that is not finite, or the episode is over
            at its start.
    """
    observation = environment.reset(seed)
    if environment.done:
        raise ValueError(f"the episode of seed {seed} is over at its start: `reset` must draw another one")
    if not hasattr(agent, "info"):
        raise ValueError(f"{type(agent).__name__} has no `info`: set self.info = {{}} in its constructor")
    agent.reset(observation.instruction, seed)
    if recorder is not None:
        recorder.start(environment)
    observations, clean, executed = [], [], []
    components, traced = len(environment.spec.action), environment if isinstance(environment, Traceable) else None
    tool = [traced.tool] if traced else []
    blind = False
    while not environment.done:
        if observations and observation.instruction != observations[-1].instruction:
            agent.reset(observation.instruction, seed)
            if blind and isinstance(agent, Looking) and agent.looks:
                return rollout(environment, agent, seed, recorder)
        action = np.array(agent.act(observation), dtype=np.float32)
        if action.shape != (components,) or not np.isfinite(action).all():
            raise ValueError(f"{type(agent).__name__} must return {components} finite numbers, got {action}")
        observations.append(_copied(observation))
        clean.append(np.array(agent.info.get("clean", action), dtype=np.float32))
        executed.append(action)
        if recorder is not None:
            recorder.step(observation, action, agent.info)
        blind = not all_images and isinstance(agent, Looking) and not agent.looks
        with environment.blind() if blind else nullcontext():
            observation = environment.step(action)
        if traced:
            tool.append(traced.tool)
    episode = Episode(
        seed=seed,
        task=environment.task,
        instruction=observations[0].instruction,
        outcome=environment.outcome,
        milestones=environment.milestones,
        draws={**environment.draws, **agent.info.get("draws", {})},
        observations=observations,
        actions=np.asarray(clean, dtype=np.float32),
        executed=np.asarray(executed, dtype=np.float32),
        completed=_completed(environment),
        tool=np.array(tool) if traced else None,
    )
    if recorder is not None:
        recorder.end(episode)
    return episode


def _copied(seen: Observation) -> Observation:
    """Return a copy with a state of 32 bits: a world may use its arrays again."""
    rgb, depth = ({name: np.array(image) for name, image in images.items()} for images in (seen.rgb, seen.depth))
    truth = None if seen.truth is None else {name: np.array(value) for name, value in seen.truth.items()}
    return replace(seen, rgb=rgb, depth=depth, truth=truth, state=np.array(seen.state, np.float32))


def _completed(environment: Environment) -> tuple[int, int] | None:
    several = isinstance(environment, InARow) and environment.instructions > 1
    return (environment.completed, environment.instructions) if several else None


class Replay(NamedTuple):
    """Result of a replay."""

    observations: list[Observation]
    differs: int | None  # first step with another state; number of replayed steps if only the end differs; None: equal


def replay(environment: Environment, episode: Episode, recorder: Recorder | None = None) -> Replay:
    """Execute the actions of an episode again from its seed; record this world with the observations of the episode."""
    observation = environment.reset(episode.seed)
    if recorder is not None:
        recorder.start(environment)
    same, seen = [], []
    for recorded, action in zip(episode.observations, episode.executed, strict=True):
        if environment.done:
            break
        seen.append(_copied(observation))
        same.append(np.array_equal(seen[-1].state, recorded.state))
        if recorder is not None:
            recorder.step(recorded, action, {})
        observation = environment.step(action)
    if recorder is not None:
        recorder.end(episode)
    if not all(same):
        return Replay(seen, same.index(False))
    ended = len(same) == len(episode.executed) and environment.done and environment.outcome == episode.outcome
    return Replay(seen, None if ended else len(same))


def close_agent(agent: Agent) -> None:
    """Close what an agent holds, such as a connection or a thread; most agents hold nothing and have no `close`."""
    if callable(close := getattr(agent, "close", None)):
        close()
