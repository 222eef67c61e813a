"""What worlds share: the state of an episode, steps without images, named random streams, commands of a gripper."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar
from zlib import crc32

import numpy as np

from vla.io.errors import UserError
from vla.parallel.limits import is_memory_scarce
from vla.spec import Array
from vla.tasks.gl import require_backend

FREE = 0.25  # share of the memory that scenes leave free
Scene = TypeVar("Scene")


class World:
    """Base class of worlds, with the attributes of an episode in `vla.spec.Environment`; at first, none has begun.

    A world draws no images while `_blind` is true.
    """

    def __init__(self) -> None:
        self.done, self.outcome, self.task = True, "timeout", ""
        self.milestones: frozenset[str] = frozenset()
        self.draws: dict[str, Any] = {}
        self._blind = False

    def _require_running(self) -> None:
        """Raise a UserError if no episode has begun, or the last one is over."""
        if self.done:
            raise UserError("no episode is running: call reset(seed) before step(action)")

    @contextmanager
    def blind(self) -> Iterator[None]:
        """Return no images within this context, which makes steps several times faster."""
        was_blind, self._blind = self._blind, True
        try:
            yield
        finally:
            self._blind = was_blind


class MultitaskWorld(World):
    """Base class of worlds with several `tasks`, through which seeds cycle, in scenes that are made when first played.

    When memory is scarce, a new scene replaces the newest one: in the cycle, the oldest scenes are needed again first.
    """

    tasks: tuple[str, ...]

    def __init__(self) -> None:
        """Begin without scenes; a UserError on a machine that cannot render."""
        super().__init__()
        require_backend()
        self._scenes: dict[str, Any] = {}

    def task_of(self, seed: int) -> str:
        """Return the task of the episode of `seed`."""
        return self.tasks[seed % len(self.tasks)]

    def _scene_of(self, name: str, make: Callable[[], Scene]) -> Scene:
        """Return the scene called `name`, which `make` makes if there is none."""
        if name not in self._scenes:
            if self._scenes and is_memory_scarce(FREE):
                self._scenes.popitem()[1].close()
            self._scenes[name] = make()
        return self._scenes[name]

    def close(self) -> None:
        """Free physics and GL of all scenes."""
        while self._scenes:
            self._scenes.popitem()[1].close()


def command_of(action: Array, reach: Array | float) -> Array:
    """Convert an action (D,), motion up to `reach` and then a gripper with 1 for open, to a command (D,) of -1…1, with
    1 for a closed gripper."""
    return np.append(action[:-1] / reach, -action[-1])


def action_of(command: Array, reach: Array | float) -> Array:
    """Convert a command (D,) to the action (D,) float32 that gives it, clipped to its bounds."""
    clipped = np.clip(command, -1, 1)
    return np.append(reach * clipped[:-1], -clipped[-1]).astype(np.float32)


class Streams:
    """Random streams of an environment, by name.

    A stream depends only on the episode's seed and its name, so draws from one do not change another. Streams are
    cached, because creating one takes ten times as long as seeding it.
    """

    def __init__(self) -> None:
        self._streams = defaultdict[str, np.random.RandomState](np.random.RandomState)

    def __call__(self, seed: int, name: str) -> np.random.RandomState:
        """Return the stream called `name`, seeded for the episode `seed`."""
        stream = self._streams[name]
        stream.seed(np.random.SeedSequence([seed, crc32(name.encode())]).generate_state(8))
        return stream
