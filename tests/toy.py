"""A world small enough to test with: a point is moved to a target, and two little cameras look on."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from vla.cluster import Local
from vla.collect import collect
from vla.data.episodes import EpisodeStore
from vla.spec import Array, Environment, Observation, Shape, Spec

SPEC = Spec(
    cameras=("front", "wrist"),
    image_size=(16, 16),
    joints=tuple(f"joint{number}" for number in range(1, 8)),
    action=("x", "y", "gripper"),
    units=("m", "m", "1"),
    low=(-0.05, -0.05, 0.0),
    high=(0.05, 0.05, 1.0),
    frame="base",
    control_hz=10.0,
    truth=(("target", 2), ("point", 2)),
    chain=tuple((0.0, 0.0, 0.1, 1.0, float(number % 2), 0.0, 0.0) for number in range(8)),
)

EPISODES = 30  # of `make_store`


class ToyEnvironment:
    """A point in a 1 m square reaches its target, unless the seed is three more than a multiple of five."""

    def __init__(self, seconds_per_step: float = 0.0, forgetful: bool = False, deadly_seed: int | None = None) -> None:
        """`forgetful` carries something over from one episode to the next; `deadly_seed` ends the process."""
        self.spec = SPEC
        self.done, self.outcome = False, "timeout"
        self.draws: dict[str, Any] = {}
        self._seconds_per_step, self._forgetful, self._deadly_seed = seconds_per_step, forgetful, deadly_seed
        self._blind = False
        self._resets = 0

    def reset(self, seed: int) -> Observation:
        """Draw a point and a target."""
        if seed == self._deadly_seed:
            os._exit(1)
        random = np.random.default_rng(seed)
        self._seed, self._steps, self._resets = seed, 0, self._resets + 1
        self._point, self._target = random.uniform(0, 1, 2), random.uniform(0, 1, 2)
        if self._forgetful:
            self._point += 1e-6 * self._resets
        self.done, self.outcome = False, "timeout"
        self.draws = {"point": self._point, "colour": random.choice(["red", "blue"]), "limit": np.int64(40)}
        return self._look()

    def step(self, action: Array) -> Observation:
        """Move the point by the first two components [m]."""
        time.sleep(0 if self._blind else self._seconds_per_step)
        self._steps += 1
        self._point = self._point + np.clip(action, SPEC.low, SPEC.high)[:2]
        reached = bool(np.linalg.norm(self._point - self._target) < 0.02) and self._seed % 5 != 3
        self.outcome = "success" if reached else "timeout"
        self.done = reached or self._steps == 40
        return self._look()

    def shapes(self) -> list[Shape]:
        """Nothing to draw."""
        return []

    def poses(self) -> dict[str, Array]:
        """Nothing to draw."""
        return {}

    @contextmanager
    def blind(self) -> Iterator[None]:
        """Observations without images."""
        self._blind = True
        try:
            yield
        finally:
            self._blind = False

    def close(self) -> None:
        """Nothing to free."""

    def _look(self) -> Observation:
        rgb: dict[str, Array] = {}
        depth: dict[str, Array] = {}
        for number, camera in enumerate(() if self._blind else SPEC.cameras):
            grid = np.hypot(*(np.mgrid[:16, :16] / 16 - self._point[:, None, None]))
            rgb[camera] = np.stack([255 * (grid % 1), grid * 0 + self._steps, grid * 0 + number], -1).astype(np.uint8)
            depth[camera] = (500 + 40000 * (grid % 1) + number).astype(np.uint16)
        joints = np.linspace(self._point[0], self._point[1], 7, dtype=np.float32)
        return Observation(
            rgb=rgb,
            depth=depth,
            joints=joints,
            velocities=joints / 10,
            gripper=0.04,
            instruction=f"go to the {self.draws['colour']} target",
            truth={"target": self._target.astype(np.float32), "point": self._point.astype(np.float32)},
        )


class ToyExpert:
    """Walks to the target with a little noise; what it means to do is in `info["clean"]`."""

    def __init__(self, noise: float = 0.005, lost: bool = False) -> None:
        """`noise` in [m]; a `lost` expert stays where it is."""
        self.info: dict[str, Any] = {}
        self._noise, self._lost = noise, lost

    def reset(self, instruction: str, seed: int) -> None:
        """Start the noise over."""
        self._random = np.random.default_rng([seed, 1])

    def act(self, observation: Observation) -> Array:
        """Towards the target, as far as one step goes."""
        assert observation.truth is not None
        way = observation.truth["target"] - observation.truth["point"]
        way = np.clip(way * (not self._lost), SPEC.low[:2], SPEC.high[:2])
        self.info = {"clean": np.array([*way, 1.0], np.float32)}
        return np.array([*(way + self._random.normal(0, self._noise, 2)), 1.0], np.float32)


def make_environment() -> ToyEnvironment:
    """The plain world."""
    return ToyEnvironment()


def make_expert(environment: Environment) -> ToyExpert:
    """The expert of the plain world."""
    return ToyExpert()


def make_slow_environment() -> ToyEnvironment:
    """A world whose episodes take long enough to be interrupted."""
    return ToyEnvironment(seconds_per_step=0.005)


def make_deadly_environment() -> ToyEnvironment:
    """A world that takes its process down with it at seed 7."""
    return ToyEnvironment(deadly_seed=7)


def make_forgetful_environment() -> ToyEnvironment:
    """A world in which no episode can be replayed."""
    return ToyEnvironment(forgetful=True)


def make_lost_expert(environment: Environment) -> ToyExpert:
    """An expert that never succeeds."""
    return ToyExpert(noise=0.0, lost=True)


def make_store(folder: Path) -> EpisodeStore:
    """A store of the expert's first episodes."""
    store = EpisodeStore.create_or_open(folder, SPEC, {})
    collect(store, make_environment, make_expert, EPISODES, Local(1), seed=0)
    return store
