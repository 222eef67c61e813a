"""Randomised factors of a report's episodes, over which success is compared."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vla.data.episode_filter import flat
from vla.rollouts.results import Result

BINS = 5  # quantile groups of a numeric factor
GROUPS = 8  # maximum number of groups in a factor's panel
COLOURS = (".rgb", ".diffuse")  # draws of three numbers whose mean is a brightness


def factors(played: Sequence[Result]) -> dict[str, list[Any]]:
    """Return title → value per episode, of every draw that all episodes have and that forms a few groups.

    A pair of numbers is one factor, a point, and of a colour its brightness; each item of another list is a factor.
    Of draws that are equal in all episodes the first counts.
    """
    rows = [
        {name: value for axis, draw in flat(result.draws).items() for name, value in _items(axis, draw)}
        for result in played
    ]
    names = [name for name in (rows[0] if rows else {}) if all(name in row for row in rows)]
    columns = dict[str, list[Any]]()
    for name in names:
        if (values := [row[name] for row in rows]) not in columns.values():
            columns[name] = values
    listed = _listed(played)
    return {in_words(name, listed): values for name, values in columns.items() if 1 < len(groups(values)) <= GROUPS}


def _items(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):  # an object in a list, which forms no groups
        return
    if not isinstance(value, list):
        yield name, value
    elif _is_point(value):
        yield name, tuple(value)
    elif name.endswith(COLOURS) and len(value) == 3 and numeric(value):
        yield f"{name.rpartition('.')[0]}.brightness", sum(value) / 3
    else:
        for index, item in enumerate(value):
            yield from _items(f"{name}[{index}]", item)


def in_words(name: str, listed: dict[str, str] | None = None) -> str:
    """Convert the dotted name of a draw to a title: "colour.names[0]" becomes "colour: name 1".

    `listed` maps a list to the objects of its items: with "colour.names" → "block" the title is "colour: name of
    block 1".
    """
    path, indices = name.partition("[")[0], [int(index) + 1 for index in re.findall(r"\[(\d+)\]", name)]
    *axis, leaf = path.replace("_", " ").split(".")
    if indices:
        leaf, thing = leaf.removesuffix("s"), (listed or {}).get(path)
        leaf += f" {indices[0]}" if thing in (None, leaf) else f" of {thing} {indices[0]}"
        leaf += "".join(f", component {index}" for index in indices[1:])
    return f"{' '.join(axis)}: {leaf}" if axis else leaf


def _listed(played: Sequence[Result]) -> dict[str, str]:
    """Infer dotted name of a list → the objects that its items describe.

    Objects have positions: a list of points under a plural name, such as "blocks". Another list with equal lengths in
    every episode describes the same objects, unless its length is always three, like a position or a colour.
    """
    lists: dict[str, list[list[Any]]] = {}
    for result in played:
        for name, value in flat(result.draws).items():
            if isinstance(value, list):
                lists.setdefault(name, []).append(value)
    lengths = {name: tuple(map(len, values)) for name, values in lists.items() if len(values) == len(played)}
    things = {
        lengths[name]: name.rpartition(".")[2].removesuffix("s")
        for name in lengths
        if name.endswith("s") and all(value and all(map(_is_point, value)) for value in lists[name])
    }
    return {name: things[each] for name, each in lengths.items() if each in things and set(each) != {3}}


def _is_point(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(item, float) for item in value)


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
