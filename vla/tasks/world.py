"""What worlds share: the state of an episode, steps without images, and named random streams."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, Protocol, TypeVar
from zlib import crc32

import numpy as np

from vla.io.errors import UserError
from vla.parallel.limits import scarce_memory

FREE = 0.25  # share of the memory that scenes leave free


class World:
    """Base class of worlds, with what `vla.spec.Environment` says of an episode; none has begun.

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
            raise UserError("the episode is over; call reset(seed) before step(action)")

    @contextmanager
    def blind(self) -> Iterator[None]:
        """Return no images within this context, which makes steps several times faster."""
        before, self._blind = self._blind, True
        try:
            yield
        finally:
            self._blind = before


class _Closable(Protocol):
    def close(self) -> None: ...


Scene = TypeVar("Scene", bound=_Closable)


class Scenes(Generic[Scene]):
    """The scenes of a world's tasks, made when first played; where memory is scarce, a new one replaces the newest.

    Tasks take turns, so the oldest ones are needed first.
    """

    def __init__(self) -> None:
        self._made: dict[str, Scene] = {}

    def of(self, name: str, make: Callable[[], Scene]) -> Scene:
        """Return the scene called `name`, which `make` makes if there is none."""
        if name not in self._made:
            if self._made and scarce_memory(FREE):
                self._made.popitem()[1].close()
            self._made[name] = make()
        return self._made[name]

    def close(self) -> None:
        """Free physics and GL of all."""
        while self._made:
            self._made.popitem()[1].close()


class Streams:
    """Random streams of an environment, by name.

    A stream depends only on the episode's seed and its name, so draws from one do not change another. Streams are
    cached, because creating one takes ten times as long as seeding it.
    """

    def __init__(self) -> None:
        self._made: dict[str, np.random.RandomState] = {}

    def __call__(self, seed: int, name: str) -> np.random.RandomState:
        """Return the stream called `name`, seeded for the episode `seed`."""
        if name not in self._made:
            self._made[name] = np.random.RandomState()
        self._made[name].seed(np.random.SeedSequence([seed, crc32(name.encode())]).generate_state(8))
        return self._made[name]
