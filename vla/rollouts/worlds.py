"""Worlds side by side, and the agent-environment loop, of which there is only this one.

Every world is a lane, and so is the agent in it. An episode is a function of its seed alone: it depends neither on the
number of lanes nor on what is played in the others.

Shapes: n lanes, D action components, N steps of an episode.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vla.io.errors import UserError
from vla.spec import Agent, Agents, Array, Environment, Episode, Observation, Recorder


class Stage:
    """One world, with the observations and actions of its current episode so far, and perhaps a recorder of them."""

    def __init__(self, environment: Environment, recorder: Recorder | None = None) -> None:
        self.environment, self._recorder = environment, recorder

    def reset(self, seed: int) -> Observation:
        """Start the episode of a seed; raise a UserError if it is over at its start."""
        self._observation = copy_observation(self.environment.reset(seed))
        if self.environment.done:
            raise UserError(f"the episode of seed {seed} is over at its start: `reset` must draw another one")
        self._seed, self._seen, self._labels, self._executed = seed, list[Observation](), list[Array](), list[Array]()
        # Read after the reset: the tool of a world may exist only from its first episode on.
        self._tool = [self._tool_position()]
        if self._recorder is not None:
            self._recorder.start(self.environment)
        return self._observation

    def step(self, action: Array, info: Mapping[str, Any], blind: bool) -> Observation | Episode:
        """Execute an action (D,); return the next observation, or the episode if it is over.

        The label for imitation is `info["clean"]` if present, else the action. What the agent drew, `info["draws"]`, is
        added to the draws of the environment.
        """
        self._seen.append(self._observation)
        self._labels.append(np.array(info.get("clean", action), dtype=np.float32))
        self._executed.append(action)
        if self._recorder is not None:
            self._recorder.step(self._observation, action, info)
        with self.environment.blind() if blind else nullcontext():
            self._observation = copy_observation(self.environment.step(action))
        if self._tool[0] is not None:
            self._tool.append(self._tool_position())
        return self._end_episode(info) if self.environment.done else self._observation

    def _tool_position(self) -> Array | None:
        """Return a copy of the position of the tool, which a world may update in place; None if it has none."""
        position = getattr(self.environment, "tool", None)
        return None if position is None else np.array(position)

    def _end_episode(self, info: Mapping[str, Any]) -> Episode:
        environment: Any = self.environment  # which may have instructions
        count = getattr(environment, "instructions", 1)
        episode = Episode(
            seed=self._seed,
            task=environment.task,
            instruction=self._seen[0].instruction,
            outcome=environment.outcome,
            milestones=environment.milestones,
            draws={**environment.draws, **info.get("draws", {})},
            observations=self._seen,
            actions=np.asarray(self._labels, dtype=np.float32),
            executed=np.asarray(self._executed, dtype=np.float32),
            completed=(environment.completed, count) if count > 1 else None,
            tool=None if self._tool[0] is None else np.array(self._tool),
        )
        if self._recorder is not None:
            self._recorder.end(episode)
        return episode


class _SingleLane:
    """Adapter of an agent of one world to `Agents`, with a single lane."""

    def __init__(self, agent: Agent) -> None:
        if not hasattr(agent, "info"):
            raise UserError(f"{type(agent).__name__} has no `info`: set self.info = {{}} in its constructor")
        self.agent = agent

    def reset(self, instruction: str, seed: int, lane: int) -> None:
        self.agent.reset(instruction, seed)

    def act(self, observations: Sequence[Observation], lanes: Sequence[int], /) -> Array:
        (observation,) = observations
        return np.array(self.agent.act(observation), dtype=np.float32)[None]

    def about(self, lane: int) -> dict[str, Any]:
        return self.agent.info

    def looking(self, lane: int) -> bool:
        return getattr(self.agent, "looks", True)


def as_agents(agent: Agent | Agents) -> Agents:
    """Return an agent as `Agents`; an agent of one world gets a single lane."""
    return agent if isinstance(agent, Agents) else _SingleLane(agent)


@dataclass
class _Episode:
    """An episode that is played in a lane."""

    seed: int
    instruction: str | None = None  # None: before the first observation
    all_images: bool = False  # whether all images are rendered
    blind: bool = False  # whether the newest observation has no images


def play(
    stages: Sequence[Stage], agents: Agents, seeds: Sequence[int], all_images: bool = True
) -> Iterator[tuple[int, Any]]:
    """Play the episodes of seeds side by side, on a stage per lane; yield (seed, `Episode` or error) as each ends.

    A new instruction resets the agent. Without `all_images`, images are rendered only at steps where the agent reads
    them; if a new instruction makes it read one that was not rendered, the episode is run again with all images.

    An error of a world, or in the reset of an agent, ends its episode. An error in `act` ends all that were to act
    together; but after a ValueError, with which no lane has acted, each acts alone, and only those that fail again end.

    As long as there are any, a lane plays the seeds that equal its number modulo the number of lanes. The seed of an
    episode determines its row in the batch of a policy, so one pass then serves all lanes.
    """
    queue, episodes = list(seeds), dict[int, _Episode]()
    answers: dict[int, Any] = {}  # of the worlds: the next observation, the ended episode, or an error
    while queue or episodes:
        for lane, stage in enumerate(stages):
            if queue and lane not in episodes:
                next_seed = next((seed for seed in queue if seed % len(stages) == lane), queue[0])
                queue.remove(next_seed)
                episodes[lane] = _Episode(next_seed, all_images=all_images)
                answers[lane] = _result_or_error(stage.reset, next_seed)
        arrivals, answers = answers, {}
        observations: dict[int, Observation] = {}
        results: dict[int, Any] = {}
        for lane, answer in arrivals.items():
            try:
                if not isinstance(answer, Observation):
                    results[lane] = answer
                elif _follow_instruction(agents, lane, episodes[lane], answer):
                    observations[lane] = answer
                else:  # an image is missing: play it again
                    episodes[lane] = _Episode(episodes[lane].seed, all_images=True)
                    answers[lane] = _result_or_error(stages[lane].reset, episodes[lane].seed)
            except Exception as error:  # of any kind: agents are user code
                results[lane] = error
        for lane, action in _actions(agents, observations, len(stages[0].environment.spec.action)).items():
            if isinstance(action, Exception):
                results[lane] = action
                continue
            episodes[lane].blind = not episodes[lane].all_images and not agents.looking(lane)
            answers[lane] = _result_or_error(stages[lane].step, action, agents.about(lane), episodes[lane].blind)
        for lane, result in results.items():
            yield episodes.pop(lane).seed, result


def _result_or_error(call: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return call(*arguments)
    except Exception as error:  # of any kind: worlds are user code
        return error


def _follow_instruction(agents: Agents, lane: int, episode: _Episode, observation: Observation) -> bool:
    """Reset the agent of a lane at a new instruction; return whether the image that it then reads was rendered."""
    if observation.instruction == episode.instruction:
        return True
    agents.reset(observation.instruction, episode.seed, lane)
    episode.instruction = observation.instruction
    return not (episode.blind and agents.looking(lane))


def _actions(agents: Agents, observations: Mapping[int, Observation], components: int) -> dict[int, Array | Exception]:
    """Return lane → its action (D,), or its error."""
    if not observations:
        return {}
    lanes = list(observations)
    try:
        actions = agents.act([observations[lane] for lane in lanes], lanes)
    except ValueError as error:
        if len(lanes) == 1:
            return {lanes[0]: error}
        return {lane: _actions(agents, {lane: observations[lane]}, components)[lane] for lane in lanes}
    except Exception as error:  # of any kind: agents are user code
        return dict.fromkeys(lanes, error)
    answers: dict[int, Array | Exception] = {}
    for lane, action in zip(lanes, actions, strict=True):
        answers[lane] = action
        if action.shape != (components,) or not np.isfinite(action).all():
            name = type(agents.agent if isinstance(agents, _SingleLane) else agents).__name__
            answers[lane] = UserError(f"{name} must return {components} finite numbers, got {action}")
    return answers


def copy_observation(observation: Observation) -> Observation:
    """Return a copy, of NumPy arrays with a float32 state: a world may reuse its arrays, or have those of PyTorch."""
    rgb, depth = (
        {name: np.array(image) for name, image in images.items()} for images in (observation.rgb, observation.depth)
    )
    truth = None if observation.truth is None else {name: np.array(value) for name, value in observation.truth.items()}
    return replace(observation, rgb=rgb, depth=depth, truth=truth, state=np.array(observation.state, np.float32))
