"""Randomised factors of a report's episodes, over which success is compared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vla.data.draws import flat
from vla.rollouts.results import Result

BINS = 5  # quantile groups of a numeric factor
GROUPS = 8  # maximum number of groups of a factor


def factors(played: Sequence[Result]) -> dict[str, list[Any]]:
    """Return name → value per episode, of every draw that all episodes have and that forms a few groups.

    A pair of numbers is a point, each item of another list is a factor. Of equal draws the first counts.
    """
    rows = [dict(item for draw in flat(result.draws).items() for item in _items(*draw)) for result in played]
    columns = dict[str, list[Any]]()
    for name in rows[0] if rows else ():
        values = [row.get(name) for row in rows]
        if None not in values and values not in columns.values():
            columns[name] = values
    return {name: values for name, values in columns.items() if 1 < len(groups(values)) <= GROUPS}


def _items(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        if len(value) == 2 and all(isinstance(item, float) for item in value):
            yield name, tuple(value)
        else:
            for index, item in enumerate(value):
                yield from _items(f"{name}[{index}]", item)
    elif not isinstance(value, dict):  # an object in a list forms no groups
        yield name, value


def numeric(values: Sequence[Any]) -> bool:
    """Return whether all values are numbers."""
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def groups(values: Sequence[Any]) -> list[list[int]]:
    """Group the indices of the episodes: by value if there are few or they are words, numbers by quantiles, points by
    quadrants around the median."""
    if isinstance(values[0], tuple):
        values = [str(quarter) for quarter in np.array(values) > np.median(values, axis=0)]
    different = sorted(set(values), key=None if numeric(values) else str)
    if len(different) <= BINS or not numeric(values):
        return [[index for index, other in enumerate(values) if other == value] for value in different]
    return [group.tolist() for group in np.array_split(np.argsort(values, kind="stable"), BINS)]


def association(values: Sequence[Any], played: Sequence[Result]) -> float:
    """Association of success with a factor: Pearson's χ² per degree of freedom, about 1 by chance."""
    good = np.array([result.success for result in played], dtype=float)
    rate, split = good.mean(), groups(values)
    if rate in (0.0, 1.0):
        return 0.0
    squares = sum(len(group) * (good[group].mean() - rate) ** 2 for group in split)
    return float(squares / (rate * (1 - rate)) / (len(split) - 1))
