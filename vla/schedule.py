"""The schedule of planned actions, wherever a plan is executed while the next one is computed.

Policies, simulated networks and clients of a policy server count time in executed actions, so that no action expires
while an arm without a due action holds still; a robot counts in seconds on its clock.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Action = TypeVar("Action")


@dataclass(frozen=True)
class Plan(Generic[Action]):
    """Consecutive actions, with the times at which they end."""

    start: float
    actions: Sequence[Action]
    ends: Sequence[float]


class Schedule(Generic[Action]):
    """Which action of which plan is due at which time; plans overlap where one begins before another has ended."""

    def __init__(self, period: float = 1.0) -> None:
        """Start without a plan; every action takes one `period`: 1 if time counts steps, or [s] on a clock."""
        self._period = period
        self._plans: list[Plan[Action]] = []  # in the order in which they were added

    @property
    def newest_plan(self) -> Plan[Action] | None:
        """The plan that was added last."""
        return self._plans[-1] if self._plans else None

    @property
    def end(self) -> float:
        """Time at which the newest plan ends; -∞ without one."""
        return self._plans[-1].ends[-1] if self._plans else -math.inf

    def add(self, actions: Sequence[Action], start: float) -> None:
        """Add a plan of at least one action, made from the observation at time `start`, when its first action begins.

        The plan may arrive later: actions whose time has passed by then are never due.
        """
        ends = [start + self._period * (place + 1) for place in range(len(actions))]
        self._plans = [*(plan for plan in self._plans if plan.ends[-1] > start), Plan(start, actions, ends)]

    def execution_end(self, execute: int) -> float:
        """Return the time at which the first `execute` actions of the newest plan have ended; -∞ without a plan."""
        return self._plans[-1].start + self._period * execute if self._plans else -math.inf

    def wants_plan(self, time: float, execute: int) -> bool:
        """Return whether the first `execute` actions of the newest plan have ended, so that a new plan is due."""
        return time >= self.execution_end(execute)

    def remaining_actions(self, time: float) -> Sequence[Action]:
        """Return the actions of the newest plan from a time on."""
        return self._plans[-1].actions[bisect_right(self._plans[-1].ends, time) :] if self._plans else []

    def actions_at(self, time: float) -> list[Action]:
        """Return the action of every plan that has one for a time, the newest last."""
        return [plan.actions[bisect_right(plan.ends, time)] for plan in self._plans if time < plan.ends[-1]]


class Delays:
    """Forecast of the delay of the next plan: the longest of the last ten, as in arXiv 2506.07339."""

    def __init__(self, period: float) -> None:
        """Count in actions of a `period` [s]."""
        self._period, self._seconds = period, deque[float](maxlen=10)

    def add(self, seconds: float) -> None:
        """Add the time from an observation to its plan [s]."""
        self._seconds.append(seconds)

    @property
    def forecast(self) -> int:
        """How many actions will have ended when the next plan arrives."""
        return math.ceil(max(self._seconds, default=0.0) / self._period - 1e-9)
