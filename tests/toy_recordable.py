"""The toy world with something to draw, agents that say what they think, and worlds in which things go wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from toy import ARM_SPEC, SPEC, ToyEnvironment, ToyExpert

from vla.spec import Array, Environment, Observation, Recorder, Shape

BINS = 16
BROKEN_SEED, DEADLY_SEED = 1_000_001, 1_000_002


class RecordableEnvironment(ToyEnvironment):
    """Every kind of solid on one body that moves, and a table that does not.

    `broken` raises at `BROKEN_SEED`; `deadly_seed` ends the process.
    """

    viewpoint = ((1.0, -1.0, 1.0), (0.5, 0.5, 0.0))

    def __init__(self, broken: bool = False, deadly_seed: int | None = None) -> None:
        super().__init__(deadly_seed=deadly_seed, spec=ARM_SPEC)
        self._broken = broken

    def reset(self, seed: int) -> Observation:
        if self._broken and seed == BROKEN_SEED:
            raise ValueError("the block fell off the table")
        return super().reset(seed)

    def shapes(self) -> list[Shape]:
        """A table of one box, and one solid of each kind on the point."""
        place = (np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([0.1, 0.2, 0.3]), np.array([1.0, 0.5, 0, 1]))
        kinds = ("box", "cylinder", "sphere", "capsule")
        solids = [Shape("arm/point", kind, kind, *place) for kind in kinds]  # type: ignore[arg-type]
        vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
        mesh = Shape("arm/point", "mesh", "mesh", *place, vertices, np.array([[0, 1, 2]], np.int32))
        return [Shape("table", "top", "box", *place), *solids, mesh]

    def poses(self) -> dict[str, Array]:
        """The point moves, the table does not."""
        still = [0, 0, 0, 1, 0, 0, 0]
        return {"table": np.array(still, np.float32), "arm/point": np.array([*self._point, *still[2:]], np.float32)}


class ThinkingAgent(ToyExpert):
    """The toy expert, with a made-up distribution over bins for what it does."""

    def act(self, observation: Observation) -> Array:
        action = super().act(observation)
        share = (action - SPEC.low) / (np.array(SPEC.high) - SPEC.low)
        peaks = np.exp(-((np.arange(BINS) - BINS * share[:, None]) ** 2))
        self.info["probabilities"] = (peaks + 1e-9) / (peaks + 1e-9).sum(axis=1, keepdims=True)
        return action


make_environment = RecordableEnvironment
make_broken_environment = partial(RecordableEnvironment, broken=True)
make_deadly_environment = partial(RecordableEnvironment, deadly_seed=DEADLY_SEED)


class OnceDeadlyEnvironment(RecordableEnvironment):
    """A world that takes its process down with it at one seed, the first time only."""

    def __init__(self, marker: Path) -> None:
        super().__init__(deadly_seed=None if marker.exists() else DEADLY_SEED)
        self._marker = marker

    def reset(self, seed: int) -> Observation:
        if seed == DEADLY_SEED:
            self._marker.touch()
        return super().reset(seed)


def make_impossible_environment() -> RecordableEnvironment:
    raise ValueError("no such mesh")


def make_agent(environment: Environment) -> ThinkingAgent:
    return ThinkingAgent()


def make_recorder(folder: Path) -> Callable[[], Recorder]:
    """A factory that a worker process can be given."""
    from vla.rollouts.recorder import RerunRecorder  # the other worlds start faster without it

    return partial(RerunRecorder, folder, pictures=0)
