"""Constrained types for constructor arguments and for records in files; `vla.annotations` validates values of them.

Every float is finite, which the validation sees to.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, MinLen, Predicate


def ascending(values: Sequence[float]) -> bool:
    """in ascending order"""
    return all(low <= high for low, high in itertools.pairwise(values))


def unique(values: Sequence[Any]) -> bool:
    """without repetitions"""
    return len({repr(value) for value in values}) == len(values)


Natural = Annotated[int, Ge(0)]
Count = Annotated[int, Ge(1)]
Seed = Annotated[int, Ge(0), Le(2**32 - 1)]  # what NumPy and Lightning take
NonNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]
Share = Annotated[float, Ge(0), Le(1)]  # a probability, a fraction
Range = Annotated[tuple[float, float], Predicate(ascending)]  # low, high
NonNegativeRange = Annotated[tuple[NonNegative, NonNegative], Predicate(ascending)]
PositiveRange = Annotated[tuple[Positive, Positive], Predicate(ascending)]
CountRange = Annotated[tuple[Count, Count], Predicate(ascending)]
ImageSize = tuple[Annotated[int, Ge(8), Le(2048)], Annotated[int, Ge(8), Le(2048)]]  # height, width [px]
Text = Annotated[str, MinLen(1)]
Names = Annotated[tuple[Text, ...], MinLen(1), Predicate(unique)]
