"""A world small enough to test with: a point is moved to a target, and a little camera looks on.

It has no robot, no depth and no drawable scene; tests that need a robot or depth use `ARM_SPEC`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vla.data.episodes import EpisodeStore
from vla.parallel.pool import Cluster
from vla.rollouts.collect import collect
from vla.spec import Array, Environment, Observation, RobotModel, Spec

SPEC = Spec(
    cameras=("eye",),
    image_size=(16, 16),
    state=("east", "north"),
    state_units=("m", "m"),
    action=("x", "y", "gripper"),
    units=("m", "m", "1"),
    low=(-0.05, -0.05, 0.0),
    high=(0.05, 0.05, 1.0),
    control_hz=10.0,
    truth=(("target", 2), ("point", 2)),
)
ARM = RobotModel(
    joints=tuple(f"joint{number}" for number in range(1, 8)),
    frame="base",
    velocities=tuple(f"speed{number}" for number in range(1, 8)),
    gripper="gripper",
    chain=tuple((0.0, 0.0, 0.1, 1.0, float(number % 2), 0.0, 0.0) for number in range(8)),
)
ARM_SPEC = replace(
    SPEC,
    cameras=("front", "wrist"),
    state=ARM.components,
    state_units=("rad",) * 7 + ("rad/s",) * 7 + ("m",),
    depth=("front", "wrist"),
    robot=ARM,
)

EPISODES = 30  # of `make_store`


class ToyEnvironment:
    """A point in a 1 m square reaches its target, unless the seed is three more than a multiple of five.

    The task is "red" or "blue"; "near" is a milestone on the way.
    """

    def __init__(
        self,
        seconds_per_step: float = 0.0,
        forgetful: bool = False,
        deadly_seed: int | None = None,
        spec: Spec = SPEC,
    ) -> None:
        """`forgetful` carries something over from one episode to the next; `deadly_seed` ends the process."""
        self.spec = spec
        self.done, self.outcome, self.task = False, "timeout", ""
        self.milestones: frozenset[str] = frozenset()
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
        self.done, self.outcome, self.milestones = False, "timeout", frozenset()
        self.draws = {"point": self._point, "colour": random.choice(["red", "blue"]), "limit": np.int64(40)}
        self.task = str(self.draws["colour"])
        return self._look()

    def step(self, action: Array) -> Observation:
        """Move the point by the first two components [m]."""
        time.sleep(0 if self._blind else self._seconds_per_step)
        self._steps += 1
        self._point = self._point + np.clip(action[:2], SPEC.low[:2], SPEC.high[:2])
        away = np.linalg.norm(self._point - self._target)
        self.milestones |= {"near"} if away < 0.2 else set()
        reached = bool(away < 0.02) and self._seed % 5 != 3
        self.outcome = "success" if reached else "timeout"
        self.done = reached or self._steps == 40
        return self._look()

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
        for number, camera in enumerate(() if self._blind else self.spec.cameras):
            height, width = self.spec.image_size
            rows, columns = np.mgrid[:height, :width]
            grid = np.hypot(rows / height - self._point[0], columns / width - self._point[1])
            rgb[camera] = np.stack([255 * (grid % 1), grid * 0 + self._steps, grid * 0 + number], -1).astype(np.uint8)
            if camera in self.spec.depth:
                depth[camera] = (500 + 40000 * (grid % 1) + number).astype(np.uint16)
        joints = np.linspace(self._point[0], self._point[1], 7)
        arm = self.spec.robot is not None
        return Observation(
            rgb=rgb,
            depth=depth,
            state=np.array([*joints, *joints / 10, 0.04] if arm else self._point, np.float32),
            instruction=f"go to the {self.draws['colour']} target",
            truth={"target": self._target.astype(np.float32), "point": self._point.astype(np.float32)},
        )


class ToyInTurn(ToyEnvironment):
    """The same with three tasks that the seeds take in turn; "b" fails more often than the others."""

    tasks: tuple[str, ...] = ("a", "b", "c")

    def task_of(self, seed: int) -> str:
        return self.tasks[seed % 3]

    def reset(self, seed: int) -> Observation:
        observation = super().reset(seed)
        self.task = self.task_of(seed)
        if self.task == "b" and seed % 2:
            self._seed = 3  # which fails
        return observation


class Telling(ToyEnvironment):
    """Episodes of ten steps at most; every action is in the draws, to the bit."""

    def step(self, action: Array) -> Observation:
        """Remember the action."""
        self.draws.setdefault("done", []).append(action.tobytes().hex())
        seen = super().step(action)
        self.done = self.done or self._steps == 10
        return seen


class ToyExpert:
    """Walks to the target with a little noise; what it means to do is in `info["clean"]`."""

    looks = False
    memoryless = True

    def __init__(self, noise: float = 0.005, lost: bool = False) -> None:
        """`noise` in [m]; a `lost` expert stays where it is."""
        self.info: dict[str, Any] = {}
        self._noise, self._lost = noise, lost

    def reset(self, instruction: str, seed: int) -> None:
        self._random = np.random.default_rng([seed, 1])

    def act(self, observation: Observation) -> Array:
        """Towards the target, as far as one step goes."""
        assert observation.truth is not None
        way = observation.truth["target"] - observation.truth["point"]
        way = np.clip(way * (not self._lost), SPEC.low[:2], SPEC.high[:2])
        self.info = {"clean": np.array([*way, 1.0], np.float32)}
        return np.array([*(way + self._random.normal(0, self._noise, 2)), 1.0], np.float32)


make_environment = ToyEnvironment
make_arm = partial(ToyEnvironment, spec=ARM_SPEC)
make_in_turn = ToyInTurn
make_slow_environment = partial(ToyEnvironment, seconds_per_step=0.005)  # long enough to be interrupted
make_deadly_environment = partial(ToyEnvironment, deadly_seed=7)
make_forgetful_environment = partial(ToyEnvironment, forgetful=True)


def make_expert(environment: Environment) -> ToyExpert:
    return ToyExpert()


def make_lost_expert(environment: Environment) -> ToyExpert:
    """An expert that never succeeds."""
    return ToyExpert(noise=0.0, lost=True)


def make_store(folder: Path, make: Callable[[], ToyEnvironment] = make_environment) -> EpisodeStore:
    """A store of the expert's first episodes."""
    store = EpisodeStore.create_or_open(folder, make().spec, {})
    collect(store, make, make_expert, EPISODES, Cluster(1, "beside"), seed=0)
    return store


class Wanderer:
    """A policy that sees the target seldom, and mostly goes astray."""

    def __init__(self) -> None:
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        self._random = np.random.default_rng([seed, 2])

    def act(self, observation: Observation) -> Array:
        """North-east, with noise."""
        return np.array([*self._random.normal(0.02, 0.02, 2), 0.0], np.float32)


def make_wanderer(environment: Environment) -> Wanderer:
    return Wanderer()
