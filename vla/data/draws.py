"""Randomisation draws of an episode, as flat names and values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def flat(draws: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted name → value of all draws of an episode."""
    values: dict[str, Any] = {}
    for name, draw in draws.items():
        if isinstance(draw, Mapping):
            values |= {f"{name}.{key}": value for key, value in flat(draw).items()}
        else:
            values[str(name)] = draw
    return values


def leaves(value: Any) -> list[Any]:
    """Return the scalars in a draw, at any depth of nested lists."""
    plain = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return [leaf for item in plain for leaf in leaves(item)] if isinstance(plain, (list, tuple)) else [plain]
