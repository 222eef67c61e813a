"""Controls for memorisation: policies without one input modality, and demonstrations replayed open loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vla.data.episodes import EpisodeStore
from vla.data.index import recording_of
from vla.io.errors import UserError
from vla.io.images import resize
from vla.io.types import Count
from vla.rollouts.rollout import AgentFactory, close_agent
from vla.rollouts.worlds import as_agents
from vla.spec import Array, Environment, Observation, Spec

Modality = Literal["images", "instruction", "both"]

GREY = 128
STRIDE = 4  # of the pixels that are compared


class AgentWithoutModality:
    """An agent whose images are grey and without depth, or whose instruction is empty, or both."""

    def __init__(self, make_agent: AgentFactory, modality: Modality, environment: Environment) -> None:
        """Hide a modality from the agent that a factory makes for the environment."""
        self._agent, self._missing, spec = make_agent(environment), modality, environment.spec
        self._rgb = {camera: np.full((*spec.image_size, 3), GREY, np.uint8) for camera in spec.cameras}
        self._depth = {camera: np.zeros(spec.image_size, np.uint16) for camera in spec.depth}
        self.info: dict[str, Any] = {}

    @property
    def looks(self) -> bool:
        """Whether the next action may depend on the images: never if they are hidden."""
        return self._missing == "instruction" and as_agents(self._agent).looking(0)

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode."""
        self._agent.reset(instruction if self._missing == "images" else "", seed)

    def act(self, observation: Observation) -> Array:
        """Return the (D,) action of the agent."""
        if self._missing != "images":
            observation = replace(observation, instruction="")
        if self._missing != "instruction":
            observation = replace(observation, rgb=self._rgb, depth=self._depth)
        action = self._agent.act(observation)
        self.info = self._agent.info
        return action

    def close(self) -> None:
        """Close the agent."""
        close_agent(self._agent)


class NearestDemonstration:
    """Replays the demonstration with the most similar first images, whatever happens; then repeats its last action.

    The demonstration has another seed, is of another recording and, if one exists, has the same instruction. The
    distance of two first images is the mean absolute difference over every `STRIDE`th row and column of all cameras, at
    the size of the demonstrations. This baseline for memorisation succeeds where remembering demonstrations is enough.
    """

    def __init__(self, folder: Path, episodes: Count | None, *, spec: Spec) -> None:
        """Read the first images of the demonstrations in a store: of the first `episodes`, or of all.

        Raises as `open_memory`.
        """
        store = open_memory(folder, episodes, spec)
        self._folder, self._entries, self._executed = folder, store.episodes, store.rows("executed")
        self._instructions = np.array([entry.instruction for entry in self._entries])
        self._seeds = np.array([entry.seed for entry in self._entries])
        self._recordings = np.array([recording_of(entry) for entry in self._entries])
        rows = [store.rows(f"rgb_{camera}") for camera in spec.cameras]
        starts = [entry.span.start for entry in self._entries]
        images = [[_subsample(array[start : start + 1])[0] for array in rows] for start in starts]
        self._cameras, self._size = spec.cameras, store.spec.image_size
        self._images = np.array(images)  # (E, cameras, h, w, 3)
        self.info: dict[str, Any] = {}
        self.reset("", 0)

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode; the demonstration is chosen at the first action."""
        self._actions: Array | None = None
        self._step = 0
        own_recordings = self._recordings[self._seeds == seed]  # a recording must not be its own memory
        self._others = ~np.isin(self._recordings, own_recordings)

    @property
    def looks(self) -> bool:
        """Whether the next action depends on the images: the first one does."""
        return self._actions is None

    def act(self, observation: Observation) -> Array:
        """Return the next (D,) action of the demonstration."""
        if self._actions is None:
            self._actions = np.array(self._executed[self._entries[self._nearest_index(observation)].span])
        action = self._actions[min(self._step, len(self._actions) - 1)]
        self._step += 1
        return np.asarray(action, np.float32)

    def _nearest_index(self, observation: Observation) -> int:
        images = [_subsample(resize(observation.rgb[camera], self._size)) for camera in self._cameras]
        query = np.stack(images).astype(np.int16)
        same_instruction = np.flatnonzero(self._others & (self._instructions == observation.instruction))
        candidates = same_instruction if len(same_instruction) else np.flatnonzero(self._others)
        if not len(candidates):
            raise UserError(f"{self._folder} has no other recording than the one that is shown: name a larger store")
        distances = [np.abs(self._images[index] - query).mean() for index in candidates]
        return int(candidates[np.argmin(distances)])


def open_memory(folder: Path, episodes: int | None, spec: Spec) -> EpisodeStore:
    """Open the store of the demonstrations to replay in a world with a spec.

    Raises a UserError if there is no such store, it has no or too few episodes, or its spec does not fit.
    """
    store = EpisodeStore(folder, episodes)
    store.require_episodes()
    store.spec.require_input(spec, f"the episode store {folder}", "the task")
    return store


def make_nearest(folder: Path, environment: Environment) -> NearestDemonstration:
    """Build the agent that replays demonstrations of a store in an environment."""
    return NearestDemonstration(folder, None, spec=environment.spec)


def _subsample(images: Array) -> Array:
    """Return every `STRIDE`th row and column of (…, H, W, 3) images."""
    return images[..., ::STRIDE, ::STRIDE, :]
