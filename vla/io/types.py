"""Constrained types for constructor arguments and records in files; validation also requires floats to be finite."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen, Predicate


def ascending(values: Sequence[float]) -> bool:
    """in ascending order"""
    return list(values) == sorted(values)


def unique(values: Sequence[Any]) -> bool:
    """without repetitions"""
    return len({repr(value) for value in values}) == len(values)


def names_a_file(name: str) -> bool:
    """usable in a file name"""
    return re.fullmatch(r"\w[\w.-]*", name) is not None


Natural = Annotated[int, Ge(0), Le(2**31 - 1)]
Count = Annotated[int, Ge(1), Le(2**31 - 1)]
Seed = Annotated[int, Ge(0), Le(2**32 - 1)]  # range of NumPy and Lightning
NonNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]
Share = Annotated[float, Ge(0), Le(1)]  # a probability, a fraction
Rate = Annotated[float, Ge(0), Lt(1)]  # of dropout, of a moving average
NonNegativeRange = Annotated[tuple[NonNegative, NonNegative], Predicate(ascending)]  # low, high
PositiveRange = Annotated[tuple[Positive, Positive], Predicate(ascending)]
NaturalRange = Annotated[tuple[Natural, Natural], Predicate(ascending)]
CountRange = Annotated[tuple[Count, Count], Predicate(ascending)]
Pixels = Annotated[int, Ge(8), Le(1024)]
ImageSize = tuple[Pixels, Pixels]  # height, width
Images = Literal["raw", "lossless", "jpeg"]  # codecs of images in a store
Quality = Annotated[int, Ge(1), Le(95)]  # of JPEG
Point = tuple[float, float, float]  # [m]
# Network sizes, bounded by the memory of a machine: model configs are also read from checkpoints.
Width = Annotated[int, Ge(1), Le(16384)]
Layers = Annotated[int, Ge(1), Le(256)]
Steps = Annotated[int, Ge(1), Le(1024)]  # of history, of a chunk of actions
Bins = Annotated[int, Ge(2), Le(65536)]
Widths = Annotated[list[Width], MinLen(1)]
Kernels = Annotated[list[Annotated[int, Ge(1), Le(31)]], MinLen(1)]
# Largest random shift of training images, vertical and horizontal [1/256 of their height].
Shift = tuple[NonNegative, NonNegative]

Text = Annotated[str, MinLen(1)]

# `**inherited: Inherited` at the end of a constructor stands for the arguments of the base class.
Inherited = Annotated[Any, "arguments of the base class"]
Names = Annotated[tuple[Text, ...], MinLen(1), Predicate(unique)]
