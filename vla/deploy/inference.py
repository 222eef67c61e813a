"""Inference of a policy in a thread of its own, beside the one that commands the arm."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from vla.rollouts.realtime import actions_per_plan
from vla.spec import Array, Observation

if TYPE_CHECKING:
    from vla.policy import Policy


class Inference:
    """One inference at a time, always in the same thread: compiled programs are kept per thread.

    The noise of a model is seeded with the number of the episode, so that it differs between episodes and repeats.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._running: Future[tuple[Array, float]] | None = None
        self._episodes = count()

    @property
    def busy(self) -> bool:
        """Whether an inference is under way, or its result has not been taken."""
        return self._running is not None

    def warm_up(self) -> None:
        """Run three inferences on noise: the first ones are slow."""
        noise = self._policy.spec.random_observation(np.random.default_rng(0))
        for _ in range(3):
            self._pool.submit(self._policy.plan, noise).result()

    def start(self, observation: Observation, is_first: bool) -> None:
        """Start an inference; `is_first` begins an episode."""
        self._running = self._pool.submit(self._plan, observation, is_first)

    def take(self) -> tuple[Array, float] | None:
        """Return actions (k, D) to execute, and the duration [s], of an inference that is done, or raise its error."""
        if self._running is None or not self._running.done():
            return None
        future, self._running = self._running, None
        return future.result()

    def forget(self) -> None:
        """Drop an inference under way; the next one waits for it."""
        self._running = None

    def close(self) -> None:
        """Wait for an inference under way, and end the thread."""
        self._pool.shutdown(cancel_futures=True)

    def _plan(self, observation: Observation, is_first: bool) -> tuple[Array, float]:
        start = time.monotonic()
        if is_first:
            self._policy.reset(observation.instruction, next(self._episodes))
        plan = self._policy.plan(observation)
        # A plan that the next one continues is executed until that one arrives.
        actions = plan if getattr(self._policy, "chunking", None) else plan[: actions_per_plan(self._policy)]
        return actions, time.monotonic() - start
