"""The one loop: an agent acts in an environment while a recorder looks on."""

from __future__ import annotations

import numpy as np

from vla.spec import Agent, Environment, Episode, Recorder


def rollout(environment: Environment, agent: Agent, seed: int, recorder: Recorder | None = None) -> Episode:
    """Run the episode that `seed` names to its end.

    The action stored for imitation is `agent.info["clean"]` where the agent gives one, else the executed action.

    Raises:
        ValueError: the agent returned an action of the wrong shape, or one that is not finite.
    """
    observation = environment.reset(seed)
    agent.reset(observation.instruction, seed)
    if recorder is not None:
        recorder.start(f"seed {seed}", environment)
    observations, clean, executed = [], [], []
    components = len(environment.spec.action)
    while not environment.done:
        action = np.asarray(agent.act(observation), dtype=np.float32)
        if action.shape != (components,) or not np.isfinite(action).all():
            raise ValueError(f"{type(agent).__name__} must return {components} finite numbers, it returned {action}")
        observations.append(observation)
        clean.append(agent.info.get("clean", action))
        executed.append(action)
        if recorder is not None:
            recorder.step(observation, action, agent.info)
        observation = environment.step(action)
    episode = Episode(
        seed=seed,
        instruction=observations[0].instruction,
        outcome=environment.outcome,
        draws=environment.draws,
        observations=observations,
        actions=np.asarray(clean, dtype=np.float32),
        executed=np.asarray(executed, dtype=np.float32),
    )
    if recorder is not None:
        recorder.end(episode)
    return episode
