"""Filter for episodes by seed, task, instruction, outcome, length and draws, written as plain data.

A condition is a text with the wildcards `*` and `?`; a number or a boolean; a range `[low, high]`, of which an end may
be null; or a list of texts, one of which must match. A name with several values matches if all of them do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from vla.data.index import Entry
from vla.io.errors import UserError, suggestion

FACTS = ("seed", "task", "instruction", "outcome", "steps")


def flatten(draws: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted name → value of all draws of an episode."""
    values: dict[str, Any] = {}
    for name, draw in draws.items():
        if isinstance(draw, Mapping):
            values |= {f"{name}.{key}": value for key, value in flatten(draw).items()}
        else:
            values[str(name)] = draw
    return values


def leaves(value: Any) -> list[Any]:
    """Return the scalars in a draw, at any depth of nested lists."""
    data = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return [leaf for item in data for leaf in leaves(item)] if isinstance(data, (list, tuple)) else [data]


def episode_filter(where: Mapping[str, Any], entries: Iterable[Entry]) -> Callable[[Entry], bool]:
    """Return the predicate of index entries that have every name in `where`, with values that all match (UserError:
    a name occurs in no entry, or a condition is of another kind).

    Args:
        where: name of a fact → condition.
        entries: the entries to filter; each name must occur in one of them.
    """
    names = dict.fromkeys(name for entry in entries for name in _facts(entry))
    for name in where:
        if name not in names:
            hint = suggestion(name, names) or f": there are {', '.join(names)}"
            raise UserError(f"inspect.where: no episode has {name}{hint}")
    conditions = {name: _condition(name, value) for name, value in where.items()}

    def matches(entry: Entry) -> bool:
        facts = _facts(entry)
        return all(
            bool(values := leaves(facts.get(name, []))) and all(map(condition, values))
            for name, condition in conditions.items()
        )

    return matches


def _facts(entry: Entry) -> dict[str, Any]:
    return {**{name: getattr(entry, name) for name in FACTS}, **flatten(entry.draws)}


def _condition(name: str, criterion: Any) -> Callable[[Any], bool]:
    """Return the predicate of a scalar; a UserError if `criterion` is no condition."""
    texts = criterion if isinstance(criterion, list) else [criterion]
    if texts and all(isinstance(text, str) for text in texts):
        patterns = [text.replace("[", "[[]") for text in texts]  # else brackets are sets of characters
        return lambda value: isinstance(value, str) and any(fnmatchcase(value, pattern) for pattern in patterns)
    if isinstance(criterion, (bool, int, float)):
        return lambda value: isinstance(value, bool) is isinstance(criterion, bool) and bool(value == criterion)
    if isinstance(criterion, list) and len(criterion) == 2 and all(end is None or _is_number(end) for end in criterion):
        low, high = (bound if end is None else end for end, bound in zip(criterion, (-np.inf, np.inf), strict=True))
        return lambda value: _is_number(value) and low <= value <= high
    raise UserError(
        f"inspect.where: {name} must be a text, in which * stands for anything, a number, a range [low, high] or a "
        f"list of texts, not {criterion!r}"
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
