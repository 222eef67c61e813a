"""Conditions of an evaluation as overrides of the task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def conditions(evaluate: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return condition → overrides of the task node: `evaluate.conditions`, then each part of `evaluate.one_by_one`.

    A part at a level is named `part_level`, such as light_hard, or `part` if all levels are equal.

    Args:
        evaluate: the plain node, whose `one_by_one` is level → argument of the task → part → value.
    """
    named: dict[str, dict[str, Any]] = dict(evaluate["conditions"])
    levels: dict[tuple[str, str], dict[str, Any]] = {}
    for level, overrides in evaluate["one_by_one"].items():
        for argument, parts in overrides.items():
            for part, value in parts.items():
                levels.setdefault((argument, part), {})[level] = value
    for (argument, part), values in levels.items():
        if len(values) > 1 and len({repr(value) for value in values.values()}) == 1:
            values = {"": next(iter(values.values()))}
        for level, value in values.items():
            named[f"{part}_{level}" if level else part] = {argument: {part: value}}
    return named
