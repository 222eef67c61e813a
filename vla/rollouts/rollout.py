"""The agent-environment loop, and the replay of its episodes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np

from vla.spec import Agent, Environment, Episode, InARow, Planner, Recorder, Traceable

EnvironmentFactory = Callable[[], Environment]
AgentFactory = Callable[[Environment], Agent]


def rollout(
    environment: Environment, agent: Agent, seed: int, recorder: Recorder | None = None, all_images: bool = True
) -> Episode:
    """Run the episode of `seed` to its end.

    Without `all_images` its observations lack those that the agent does not look at. If the instruction changes, which
    makes it look, the episode starts again with all of them.

    The label for imitation is `agent.info["clean"]` if present, else the executed action. What the agent drew,
    `agent.info["draws"]`, is added to the draws of the environment. A new instruction resets the agent.

    Raises:
        ValueError: the agent returned an action of the wrong shape, or one that is not finite.
    """
    observation = environment.reset(seed)
    agent.reset(observation.instruction, seed)
    if recorder is not None:
        recorder.start(f"seed {seed}", environment)
    observations, clean, executed = [], [], []
    components, traced = len(environment.spec.action), environment if isinstance(environment, Traceable) else None
    tool = [traced.tool] if traced else []
    blind = False
    while not environment.done:
        if observations and observation.instruction != observations[-1].instruction:
            if blind:
                return rollout(environment, agent, seed, recorder)
            agent.reset(observation.instruction, seed)
        action = np.asarray(agent.act(observation), dtype=np.float32)
        if action.shape != (components,) or not np.isfinite(action).all():
            raise ValueError(f"{type(agent).__name__} must return {components} finite numbers, got {action}")
        observations.append(observation)
        clean.append(agent.info.get("clean", action))
        executed.append(action)
        if recorder is not None:
            recorder.step(observation, action, agent.info)
        blind = not all_images and isinstance(agent, Planner) and agent.planned
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


def _completed(environment: Environment) -> tuple[int, int] | None:
    several = isinstance(environment, InARow) and environment.instructions > 1
    return (environment.completed, environment.instructions) if several else None


def replay(environment: Environment, episode: Episode, recorder: Recorder | None = None) -> int | None:
    """Execute the actions of an episode again from its seed; records this world with the observations of the episode.

    Returns the first step whose state differs in any bit, N if only the end of the episode differs, or None.
    """
    observation = environment.reset(episode.seed)
    if recorder is not None:
        recorder.start(f"seed {episode.seed}", environment)
    same = []
    for recorded, action in zip(episode.observations, episode.executed, strict=True):
        if environment.done:
            break
        same.append(np.array_equal(observation.state, recorded.state))
        if recorder is not None:
            recorder.step(recorded, action, {})
        observation = environment.step(action)
    if recorder is not None:
        recorder.end(episode)
    if not all(same):
        return same.index(False)
    ended = len(same) == len(episode.executed) and environment.done and environment.outcome == episode.outcome
    return None if ended else len(same)


def close_agent(agent: Agent) -> None:
    """Close what an agent holds, such as a connection or a thread; most agents hold nothing and have no `close`."""
    if callable(close := getattr(agent, "close", None)):
        close()
