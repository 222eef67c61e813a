"""Comparison of two plain configs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Keys that do not change the result of a run.
IGNORED_KEYS = ("output", "cluster", "job", "resume", "trust", "export")
ABSENT = "-"  # value of a key that one of two configs lacks


def value_at(config: Any, key: str, default: Any = ABSENT) -> Any:
    """Return the value of a plain config at a dotted key, or `default`."""
    for name in key.split("."):
        if not isinstance(config, Mapping) or name not in config:
            return default
        config = config[name]
    return config


def differences(one: Any, other: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    """Return dotted key and both values of every difference between two plain configs, except `IGNORED_KEYS`.

    A node that only one config has is one entry, with `ABSENT` for the other; top-level ones, of jobs, are left out.
    """
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return [] if one == other else [(key, one, other)]
    entries = []
    for name in dict.fromkeys((*one, *other)):
        if key or (name in one and name in other and name not in IGNORED_KEYS):
            values = one.get(name, ABSENT), other.get(name, ABSENT)
            entries += differences(*values, f"{key}.{name}" if key else str(name))
    return entries
