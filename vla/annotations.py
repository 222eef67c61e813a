"""Plain values against the type annotations of those who want them.

`Annotated[int, 1]` is a number that is at least 1.
"""

from __future__ import annotations

import os
import types
from collections.abc import Collection, Iterable, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

LISTS = (list, Sequence, Collection, Iterable, object)
MAPPINGS = (dict, Mapping, MutableMapping, object)
SCALARS: dict[type, tuple[Any, ...]] = {
    bool: (bool, object),
    int: (int, float, object),
    float: (float, object),
    str: (str, Path, os.PathLike, object),
}


def matches(value: Any, annotation: Any) -> bool:
    """Whether a plain value may stand where `annotation` is asked for; nodes with a `_target_` are what they make."""
    kind, arguments = get_origin(annotation) or annotation, get_args(annotation)
    if kind is Any or isinstance(kind, TypeVar):
        return True
    if kind in (Union, types.UnionType):
        return any(matches(value, argument) for argument in arguments)
    if kind is Annotated:
        return matches(value, arguments[0]) and value >= arguments[1]
    if kind is Literal:
        return any(type(value) is type(choice) and value == choice for choice in arguments)
    if value is None:
        return kind in (None, types.NoneType, object)
    if isinstance(value, dict):
        if "_target_" in value:
            return kind not in (bool, int, float, str, Path)
        of = arguments[1] if arguments else Any
        return kind in MAPPINGS and all(matches(item, of) for item in value.values())
    if isinstance(value, list):
        return _matches_list(value, kind, arguments)
    return kind in SCALARS.get(type(value), ())


def _matches_list(value: list[Any], kind: Any, arguments: tuple[Any, ...]) -> bool:
    if kind is tuple and arguments and arguments[-1] is not Ellipsis:
        pairs = zip(value, arguments, strict=False)
        return len(value) == len(arguments) and all(matches(item, argument) for item, argument in pairs)
    arrays = getattr(kind, "__name__", "") == "ndarray"
    return arrays or (kind in (*LISTS, tuple) and all(matches(item, arguments[0]) for item in value if arguments))


def describe(annotation: Any) -> str:
    """The annotation in words."""
    kind, arguments = get_origin(annotation), get_args(annotation)
    if kind is Literal:
        return f"one of {', '.join(str(choice) for choice in arguments)}"
    if kind in (Union, types.UnionType):
        return " or ".join(describe(argument) for argument in arguments)
    if kind is Annotated:
        return f"{describe(arguments[0])}, at least {arguments[1]}"
    if annotation in (None, types.NoneType):
        return "null"
    if arguments:
        inner = ", ".join("…" if argument is Ellipsis else describe(argument) for argument in arguments)
        return f"{getattr(kind, '__name__', kind)}[{inner}]"
    return str(getattr(annotation, "__name__", annotation))
