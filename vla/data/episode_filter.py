"""Filter for episodes by seed, task, instruction, outcome, length and draws, written as plain data.

A condition is a text with the wildcards `*` and `?`; a number or a boolean; a range `[low, high]`, of which an end may
be null; or a list of texts, one of which must match. A name with several values, such as a draw per block, matches if
all of them do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

from vla.data.draws import flat, leaves
from vla.data.index import Entry
from vla.io.errors import UserError
from vla.io.suggestion import suggestion

FACTS = ("seed", "task", "instruction", "outcome", "steps")


def facts(entry: Entry) -> dict[str, Any]:
    """Return name → value of an index entry; draws have dotted names."""
    return {**{name: getattr(entry, name) for name in FACTS}, **flat(entry.draws)}


def episode_filter(where: Mapping[str, Any], entries: Iterable[Entry]) -> Callable[[Entry], bool]:
    """Return the predicate of index entries that all conditions match.

    An entry matches a condition if it has values of that name, and all of them match.

    Args:
        where: name of a fact → condition.
        entries: the entries to filter; each name must occur in one of them.

    Raises:
        UserError: a name occurs in no entry, or a condition is of another kind.
    """
    known = dict.fromkeys(name for entry in entries for name in facts(entry))
    for name, condition in where.items():
        if name not in known:
            hint = suggestion(name, known) or f": there are {', '.join(known)}"
            raise UserError(f"inspect.where: no episode has {name}{hint}")
        if not (isinstance(condition, (str, bool, int, float)) or _is_range(condition) or _is_texts(condition)):
            raise UserError(
                f"inspect.where: {name} must be a text, in which * stands for anything, a number, a range "
                f"[low, high] or a list of texts, not {condition!r}"
            )

    def matches(entry: Entry) -> bool:
        values = {name: leaves(value) for name, value in facts(entry).items() if name in where}
        return all(
            values.get(name) and all(_matches(value, condition) for value in values[name])
            for name, condition in where.items()
        )

    return matches


def _is_range(condition: Any) -> bool:
    ends = isinstance(condition, list) and len(condition) == 2
    return ends and all(end is None or _is_number(end) for end in condition) and condition != [None, None]


def _is_texts(condition: Any) -> bool:
    return isinstance(condition, list) and bool(condition) and all(isinstance(item, str) for item in condition)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _matches(value: Any, condition: Any) -> bool:
    if isinstance(condition, list) and not _is_texts(condition):
        low, high = condition
        return _is_number(value) and (low is None or low <= value) and (high is None or value <= high)
    if isinstance(value, str):
        return any(
            fnmatchcase(value, str(word)) for word in (condition if isinstance(condition, list) else [condition])
        )
    return isinstance(value, bool) is isinstance(condition, bool) and bool(value == condition)
