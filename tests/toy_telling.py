"""The toy world with short episodes whose draws tell what was done in them."""

from __future__ import annotations

from toy import ToyEnvironment

from vla.spec import Array, Observation


class Telling(ToyEnvironment):
    """Episodes of ten steps at most; every action is in the draws, to the bit."""

    def step(self, action: Array) -> Observation:
        """Remember the action."""
        self.draws.setdefault("done", []).append(action.tobytes().hex())
        seen = super().step(action)
        self.done = self.done or self._steps == 10
        return seen
