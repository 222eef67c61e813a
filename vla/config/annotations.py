"""Validation of plain values and nodes against type annotations, and the list of allowed classes.

pydantic validates values. A node, a mapping with a `_target_`, is valid if its class is a subclass of the annotation.
"""

from __future__ import annotations

import inspect
import json
import os
import types
from collections.abc import Collection, Iterable, Mapping, MutableMapping, Sequence
from functools import cache
from importlib import import_module
from math import isfinite
from pathlib import Path
from socket import gethostname
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen, Predicate
from pydantic import BeforeValidator, ConfigDict, TypeAdapter, ValidationError

from vla.config.packages import can_be_trusted, is_trusted
from vla.io.documents import mappings
from vla.io.errors import UserError

# Configs also come from checkpoints and stores of other people. A `_target_` may name a class of this package, one of
# those that `conf/` uses, or one that the user trusts.
OWN = "vla."
LIBRARY = (
    "lightning.Trainer",
    "lightning.pytorch.loggers.CSVLogger",
    "lightning.pytorch.loggers.MLFlowLogger",
    "lightning.pytorch.loggers.TensorBoardLogger",
    "lightning.pytorch.loggers.WandbLogger",
    "lightning.pytorch.strategies.ModelParallelStrategy",
)

SCALARS = (bool, int, float, str, types.NoneType)
SEQUENCES = (list, Sequence, Collection, Iterable)
MAPPINGS = (dict, Mapping, MutableMapping)
PATHS = (Path, os.PathLike)
IN_EVERY_PROTOCOL = {"__init__", "__subclasshook__", "_no_init_or_replace_init"}
BOUNDS = {Ge: "at least {0.ge}", Gt: "more than {0.gt}", Le: "at most {0.le}", Lt: "less than {0.lt}"}
WORDS: dict[Any, tuple[str, str]] = {  # type → one, several
    bool: ("true or false", "true or false"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("text", "texts"),
    dict: ("a mapping", "mappings"),
    object: ("any value", "values"),
}
ENDLESS = 2**31 - 1  # an upper bound that descriptions omit


class MissingLibrary(UserError):
    """A class that this machine cannot import, because a library is not installed."""


def locate(key: str, target: Any) -> type:
    """Import the class that the `_target_` at `key` names.

    Raises:
        MissingLibrary: a library is not installed.
        UserError: the class is not allowed or does not exist.
    """
    require_trusted(key, target)
    if not isinstance(target, str) or not (target.startswith(OWN) or target in LIBRARY or is_trusted(target)):
        raise UserError(
            f"{key} must name a class of {OWN.rstrip('.')}, of a package that trust=[…] names, or one of "
            f"{', '.join(LIBRARY)}, got {target!r}"
        )
    module, _, name = target.rpartition(".")
    package = target.partition(".")[0]
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        where = "" if target.startswith(OWN) else f" on {gethostname()}, where {package} must be installed"
        library = isinstance(error, ModuleNotFoundError) and not f"{error.name}.".startswith(f"{package}.")
        kind = MissingLibrary if library else UserError
        raise kind(f"{key} is {target}, which cannot be imported{where}: {error}") from error
    # A module's attributes include its imports, such as `os`.
    defined = isinstance(found, type) and found.__module__.partition(".")[0] in (OWN.rstrip("."), package)
    if not isinstance(found, type) or not (target in LIBRARY or defined):
        raise UserError(f"{key} must name a class that is defined in {package}, got {target!r}")
    return found


def require_trusted(source: object, target: Any) -> None:
    """Raise a UserError if `target`, named by `source`, belongs to a package that can be trusted but is not."""
    if not isinstance(target, str) or target.startswith(OWN) or target in LIBRARY or is_trusted(target):
        return
    package, dot, _ = target.partition(".")
    if dot and can_be_trusted(package):
        raise UserError(f"{source} names {target}, which is not trusted: add trust=[{package}] if you trust its source")


def is_node(value: Any) -> bool:
    """Return whether a plain value describes an object."""
    return isinstance(value, dict) and "_target_" in value


def targets(value: Any) -> list[Any]:
    """Return every `_target_` in a plain value."""
    return [part["_target_"] for part in mappings(value) if is_node(part)]


def packages(value: Any) -> list[Any]:
    """Return every package that a node in a plain value has imported: its argument `package`."""
    return [part["package"] for part in mappings(value) if is_node(part) and "package" in part]


def require_trusted_package(source: object, package: Any) -> None:
    """Raise a UserError if `package`, which `source` has imported, is not trusted."""
    if not isinstance(package, str) or not is_trusted(package):
        raise UserError(
            f"{source} uses {package!r}, which is not trusted: add trust=[{package}] if you trust its source"
        )


def fits(found: type, expected: Any) -> bool:
    """Return whether the class `found` satisfies `expected`, a class, a union or a protocol."""
    if get_origin(expected) in (Union, types.UnionType):
        return any(fits(found, each) for each in get_args(expected))
    expected = get_origin(expected) or expected
    if not isinstance(expected, type):
        return False
    if getattr(expected, "_is_protocol", False):
        methods = {name for name, member in vars(expected).items() if inspect.isfunction(member)}
        return all(any(name in vars(base) for base in found.__mro__) for name in methods - IN_EVERY_PROTOCOL)
    return issubclass(found, expected)


def matches(value: Any, annotation: Any) -> bool:
    """Return whether a plain value, with checked nodes in place of objects, is valid for `annotation`."""
    try:
        _adapter(annotation).validate_json(json.dumps(value), strict=True)
    except ValidationError:
        return False
    return True


def describe(annotation: Any) -> str:
    """Describe an annotation in words."""
    kind, arguments = get_origin(annotation), get_args(annotation)
    if kind is Literal:
        return f"one of {', '.join(str(choice) for choice in arguments)}"
    if kind in (Union, types.UnionType):
        choices = [describe(argument) for argument in arguments]
        return (", or " if any("," in choice for choice in choices) else " or ").join(choices)
    if kind is Annotated:
        return ", ".join([describe(arguments[0]), *_bounds(arguments[1:])])
    if annotation in (None, types.NoneType):
        return "null"
    if kind is tuple or kind in SEQUENCES:
        return _describe_list(
            [part for part in arguments if part is not Ellipsis], kind is tuple and ... not in arguments
        )
    if kind in MAPPINGS:
        return f"a mapping of names to {_plural(arguments[1])}"
    if annotation in WORDS:
        return WORDS[annotation][0]
    return str(getattr(arguments[1] if arguments else annotation, "__name__", annotation))


def _describe_list(parts: Sequence[Any], fixed: bool) -> str:
    if len(set(parts)) > 1:
        return f"a list of {', '.join(describe(part) for part in parts)}"
    return f"a list of {f'{len(parts)} ' if fixed else ''}{_plural(parts[0])}"


def _plural(annotation: Any) -> str:
    if get_origin(annotation) is Annotated:
        inner, *bounds = get_args(annotation)
        return f"{_plural(inner)}, each {', '.join(_bounds(bounds))}"
    return WORDS[annotation][1] if annotation in WORDS else f"values, each {describe(annotation)}"


def takes_path(annotation: Any) -> bool:
    """Return whether values of this annotation are paths."""
    return annotation in PATHS or get_origin(annotation) in PATHS or any(map(takes_path, get_args(annotation)))


def _bounds(constraints: Iterable[Any]) -> list[str]:
    words = []
    for constraint in constraints:
        if isinstance(constraint, Predicate):
            words.append(str(constraint.func.__doc__))
        elif isinstance(constraint, MinLen):
            words.append("not empty" if constraint.min_length == 1 else f"at least {constraint.min_length} long")
        elif isinstance(constraint, MaxLen):
            words.append(f"at most {constraint.max_length} long")
        elif not isinstance(constraint, Le) or constraint.le != ENDLESS:
            words.append(BOUNDS[type(constraint)].format(constraint))
    return words


@cache
def _adapter(annotation: Any) -> TypeAdapter[Any]:
    return TypeAdapter(_of_json(annotation), config=ConfigDict(allow_inf_nan=False))


def _of_json(annotation: Any) -> Any:
    """Convert `annotation` for pydantic's validation of JSON: classes become nodes, sequences become lists."""
    kind, arguments = get_origin(annotation), get_args(annotation)
    if annotation in SCALARS or annotation is None or kind is Literal:
        return annotation
    if kind is Annotated:
        return Annotated[(_of_json(arguments[0]), *arguments[1:])]  # type: ignore[invalid-annotation]
    if kind in (Union, types.UnionType):
        return Union[tuple(map(_of_json, arguments))]  # type: ignore[invalid-annotation]  # noqa: UP007
    if (kind or annotation) in PATHS:
        return Annotated[str, MinLen(1)]
    if kind is tuple:
        return tuple[tuple(each if each is Ellipsis else _of_json(each) for each in arguments)]  # type: ignore[misc]
    if (kind or annotation) in SEQUENCES:
        return list[_of_json(arguments[0]) if arguments else Any]  # type: ignore[misc]
    if (kind or annotation) in MAPPINGS:
        return dict[str, _of_json(arguments[1]) if arguments else Any]  # type: ignore[misc]
    if annotation is object:  # the caller validates it
        return Any
    if annotation in (Any, inspect.Parameter.empty) or isinstance(annotation, TypeVar):
        return Annotated[Any, BeforeValidator(_plain)]
    if getattr(kind, "__name__", "") == "Callable":
        return Annotated[Any, BeforeValidator(lambda value: _node(value, arguments[1], partial=True))]
    return Annotated[Any, BeforeValidator(lambda value: _node(value, annotation, partial=False))]


def _plain(value: Any) -> Any:
    if is_node(value):
        raise UserError("no object belongs here")
    if isinstance(value, float) and not isfinite(value):
        raise UserError("numbers are finite")
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _plain(part)
    return value


def _node(value: Any, expected: Any, partial: bool) -> Any:
    if not is_node(value) or bool(value.get("_partial_")) is not partial:
        raise UserError("not a node")
    if not fits(locate("_target_", value["_target_"]), expected):
        raise UserError("a node of another class")
    return value
