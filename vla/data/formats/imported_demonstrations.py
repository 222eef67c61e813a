"""Existing demonstrations in place of an expert: their episodes are copied into the store.

Shapes: N steps.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vla.data.episodes import EpisodeStore, observations_of
from vla.io.errors import UserError, counted
from vla.io.printable import track
from vla.spec import Array, Episode, Spec

log = logging.getLogger(__name__)

OUTLIER_QUANTILES = (0.01, 0.99)
OUTLIER_MARGIN = 0.5  # by which bounds exceed the quantiles, as a fraction of the distance between these
# Distance between the quantiles, as a fraction of the range, below which other values are rare events, no outliers …
RARE_EVENT_SPREAD = 0.02
RARE_EVENTS = 1e-3  # … if they are at least this share of all
BOUNDS_TOLERANCE = 1e-3  # of the bounds of actions, as a fraction of their range


@dataclass(frozen=True)
class Recording:
    """Content of a recording, from which `conf/task/recorded.yaml` takes the spec."""

    cameras: tuple[str, ...]
    control_hz: float
    state: tuple[str, ...]  # components
    action: tuple[str, ...]  # components
    bounds: Mapping[str, tuple[float, float]]  # action component → low and high
    episodes: int  # their number


class ImportedDemonstrations(ABC):
    """Base class of imported episodes; `spec`, the layout of their steps, has no truth."""

    spec: Spec

    @classmethod
    def recording(cls, **options: Any) -> Recording:
        """Describe the recording named by `options`, the arguments of the constructor without the spec (UserError: it
        is missing or damaged, or this format is for given tasks only)."""
        raise UserError(f"{cls.__name__} does not describe its recordings for task=recorded: choose their own task")

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of episodes."""

    @abstractmethod
    def episode(self, number: int) -> Episode:
        """Return one episode; its number is its seed."""

    @abstractmethod
    def numbers(self, number: int) -> tuple[str, Array, Array]:
        """Return an episode without its images: instruction, state (N, P) and actions (N, D)."""

    def recorded_episode(
        self,
        number: int,
        instruction: str,
        outcome: str,
        recorded: Mapping[str, Any],
        rows: Mapping[str, Array],
        actions: Array,
        executed: Array | None = None,
    ) -> Episode:
        """Make an episode from its rows by field, except depth, which is set to 0, and from actions (N, D), clipped."""
        spec = self.spec
        depth = {f"depth_{camera}": np.zeros((len(actions), *spec.image_size), np.uint16) for camera in spec.depth}
        clipped_actions = self._clip(actions)
        return Episode(
            seed=number,
            task="recorded",
            instruction=instruction,
            outcome=outcome,
            milestones=frozenset(),
            draws={"recorded": recorded},
            observations=observations_of(spec, {**rows, **depth}, instruction),
            actions=clipped_actions,
            executed=clipped_actions if executed is None else executed,
        )

    def fill(self, store: EpisodeStore, episodes: int) -> int:
        """Append episodes until the store holds `episodes`; returns the number appended (UserError: there are too few,
        the store holds other ones, one is damaged, or the disk is full)."""
        self.require_enough(episodes)
        if episodes < len(self):
            log.info("collect.episodes=%d of the %d recorded episodes are used", episodes, len(self))
        store.require_growable()
        self.require_held(store)
        with store.writing():  # another process may have added some meanwhile
            next_seed = store.next_seed or 0
            if (limit := len(store.episodes) + len(self) - next_seed) < episodes:  # damaged ones are not imported again
                raise UserError(f"only {counted(limit, 'whole episode')}: set collect.episodes={limit}, or fewer")
            numbers = range(next_seed, next_seed + episodes - len(store.episodes))
            for number in track(numbers, "importing"):
                store.append(self.episode(number))
        return len(numbers)

    def _clip(self, actions: Array) -> Array:
        return np.clip(actions, self.spec.low, self.spec.high).astype(np.float32)

    def require_enough(self, episodes: int) -> None:
        """Raise a UserError if there are fewer than `episodes` recorded episodes."""
        if episodes > (count := len(self)):
            raise UserError(f"only {counted(count, 'recorded episode')}: set collect.episodes={count}, or fewer")

    def require_held(self, store: EpisodeStore) -> None:
        """Raise a UserError unless the episodes that a store and this recording share are the same but for images."""
        states, actions = store.rows("state"), store.rows("action")
        for entry in store.episodes:
            if entry.seed >= len(self):
                continue
            instruction, state, action = self.numbers(entry.seed)
            state, action = np.asarray(state, np.float32), self._clip(action)
            same = np.array_equal(states[entry.span], state) and np.array_equal(actions[entry.span], action)
            if entry.instruction != instruction or not same:
                raise UserError(
                    f"{store.folder} differs from the recording, first in episode {entry.seed}: delete it if it was "
                    "imported from an earlier version of that, or choose another collect.folder"
                )


def action_bounds(values: Array) -> tuple[float, float]:
    """Return bounds for a component of the actions, given its values (N,).

    They are the smallest and the largest value, unless one is an outlier: further from the quantiles than
    `OUTLIER_MARGIN` times the distance between these. In a component that hardly moves otherwise, such as a gripper,
    only a share below `RARE_EVENTS` of its values can be outliers, and in one that does not move at all none.
    """
    lower, upper = float(values.min()), float(values.max())
    low, high = (float(quantile) for quantile in np.quantile(values, OUTLIER_QUANTILES))
    margin = OUTLIER_MARGIN * (high - low)
    outside = float(((values < low - margin) | (values > high + margin)).mean())
    if high - low > RARE_EVENT_SPREAD * (upper - lower) or (high > low and outside < RARE_EVENTS):
        lower, upper = max(lower, low - margin), min(upper, high + margin)
    margin = 1e-3 * max(1.0, abs(lower)) if lower == upper else 0.0
    return lower - margin, upper + margin


def out_of_bounds(actions: Array, spec: Spec, max_share: float) -> list[str]:
    """Describe components that exceed the bounds in more than a share `max_share` of (N, D) actions: other units."""
    descriptions = list[str]()
    for index, (name, low, high) in enumerate(zip(spec.action, spec.low, spec.high, strict=True)):
        values, slack = actions[:, index], BOUNDS_TOLERANCE * (high - low)
        if (share := ((values < low - slack) | (values > high + slack)).mean()) > max_share:
            unit = "" if spec.units[index] == "1" else f" {spec.units[index]}"
            descriptions.append(
                f"its action {name} is from {values.min():.3g} to {values.max():.3g}, {share:.0%} of it beyond the "
                f"bounds of the task, {low:g} to {high:g}{unit} (other units, or absolute?)"
            )
    return descriptions


def log_clipped(actions: Array, spec: Spec) -> None:
    """Log how many of the (N, D) actions are clipped to the bounds of a spec."""
    clipped = np.clip(actions, np.array(spec.low, np.float32), np.array(spec.high, np.float32))
    if share := float((clipped != actions).any(axis=1).mean()):
        log.info("%.2g %% of the actions are clipped to the bounds of the task", 100 * share)
