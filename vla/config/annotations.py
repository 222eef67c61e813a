"""Validation of plain values and nodes against type annotations, and the list of allowed classes.

pydantic validates values. A node, a mapping with a `_target_`, is valid if its class is a subclass of the annotation.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import types
from collections.abc import Collection, Iterable, Mapping, MutableMapping, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires
from math import isfinite
from pathlib import Path
from socket import gethostname
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from annotated_types import MinLen, Predicate
from pydantic import AfterValidator, BeforeValidator, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from vla.config.packages import can_be_trusted, is_trusted
from vla.io.documents import mappings
from vla.io.errors import UserError, suggestion

# Configs also come from policies and stores of other people. A `_target_` may name a class of this package, one of
# those that `conf/` uses, or one that the user trusts.
OWN_PACKAGE, OWN_PREFIX = "vla", "vla."
LIBRARY = (
    "lightning.Trainer",
    "lightning.pytorch.loggers.CSVLogger",
    "lightning.pytorch.loggers.MLFlowLogger",
    "lightning.pytorch.loggers.TensorBoardLogger",
    "lightning.pytorch.loggers.WandbLogger",
)

SCALARS = (bool, int, float, str, types.NoneType)
SEQUENCES = (list, Sequence, Collection, Iterable)
MAPPINGS = (dict, Mapping, MutableMapping)
PATHS = (Path, os.PathLike)
IN_EVERY_PROTOCOL = {"__init__", "__subclasshook__", "_no_init_or_replace_init"}


class MissingLibrary(UserError):
    """A class that this machine cannot import, because a library is not installed."""


def locate(key: str, target: Any) -> type:
    """Import the class that the `_target_` at `key` names; raise a UserError if it is not allowed or does not exist."""
    require_trusted(key, target)
    if not isinstance(target, str) or not (target.startswith(OWN_PREFIX) or target in LIBRARY or is_trusted(target)):
        raise UserError(
            f"{key} must name a class of {OWN_PACKAGE}, of a package that trust=[…] names, or one of "
            f"{', '.join(LIBRARY)}, got {target!r}"
        )
    module, _, name = target.rpartition(".")
    package = target.partition(".")[0]
    try:
        attribute = getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        place = "" if target.startswith(OWN_PREFIX) else f" on {gethostname()}, where {package} must be installed"
        library = isinstance(error, ModuleNotFoundError) and not f"{error.name}.".startswith(f"{package}.")
        kind, hint = (MissingLibrary, install_hint(str(error.name))) if library else (UserError, "")
        raise kind(f"{key} is {target}, which cannot be imported{place}: {error}{hint}") from error
    # A module's attributes include its imports, such as `os`.
    if not isinstance(attribute, type) or attribute.__module__.partition(".")[0] not in (OWN_PACKAGE, package):
        raise UserError(f"{key} must name a class that is defined in {package}, got {target!r}")
    return attribute


def install_hint(module: str) -> str:
    """Return a hint on how to install the extra of this package that provides a module; "" if none does."""
    try:
        requirements = requires("vla") or []
    except PackageNotFoundError:  # run from a folder without installation
        return ""
    pattern = rf"{re.escape(module.partition('.')[0])}\b.*extra == '(\w+)'"
    # The last match counts, in alphabetical order: of the extras with transformers that is vlm, which suffices for all.
    *_, extra = ["", *(match[1] for requirement in requirements if (match := re.match(pattern, requirement)))]
    return f"; install vla with its extra {extra}: pip install -e '.[{extra}]'" if extra else ""


def require_trusted(source: object, target: Any, is_package: bool = False) -> None:
    """Raise a UserError if `target`, named by `source`, belongs to a package that can be trusted but is not.

    `is_package`: `target` is itself the name of a package to import.
    """
    if not isinstance(target, str) or target.startswith(OWN_PREFIX) or target in LIBRARY or is_trusted(target):
        return
    package, dot, _ = target.partition(".")
    if is_package or (dot and can_be_trusted(package)):
        raise UserError(f"{source} names {target}, which is not trusted: add trust=[{package}] if you trust its source")


def is_node(value: Any) -> bool:
    """Return whether a plain value describes an object."""
    return isinstance(value, dict) and "_target_" in value


def targets(value: Any) -> list[Any]:
    """Return every `_target_` in a plain value."""
    return [part["_target_"] for part in mappings(value) if is_node(part)]


def packages(value: Any) -> list[Any]:
    """Return the argument `package` of every node in a plain value, the name of a package that the node imports."""
    return [part["package"] for part in mappings(value) if is_node(part) and "package" in part]


def fits(candidate: type, expected: Any) -> bool:
    """Return whether the class `candidate` satisfies `expected`, a class, a union or a protocol."""
    if get_origin(expected) in (Union, types.UnionType):
        return any(fits(candidate, alternative) for alternative in get_args(expected))
    expected = get_origin(expected) or expected
    if not isinstance(expected, type):
        return False
    if getattr(expected, "_is_protocol", False):
        methods = {name for name, member in vars(expected).items() if inspect.isfunction(member)}
        return all(any(name in vars(base) for base in candidate.__mro__) for name in methods - IN_EVERY_PROTOCOL)
    return issubclass(candidate, expected)


def takes_path(annotation: Any) -> bool:
    """Return whether values of this annotation are paths."""
    return annotation in PATHS or get_origin(annotation) in PATHS or any(map(takes_path, get_args(annotation)))


def mismatch(key: str, value: Any, annotation: Any) -> str:
    """Describe how a plain value at `key`, with checked nodes in place of objects, violates its annotation; or ""."""
    try:
        _adapter(annotation).validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False, include_context=False)
    else:
        return ""
    # Members of a union fail at different depths: the deepest error is the most specific.
    path, part = max((_part_at(value, detail["loc"]) for detail in errors), key=lambda place: len(place[0]))
    reasons = dict.fromkeys(
        "longer" if detail["type"] == "missing" else detail["msg"]
        for detail in errors
        if _part_at(value, detail["loc"])[0] == path
    )
    words = [re.sub(r"^\w+ should (be )?| after validation.*", "", text).replace("None", "null") for text in reasons]
    verb = "must" if words[0].startswith(("have ", "match ")) else "must be"
    sentence = f"{key}{path} {verb} {' or '.join(words)}, got {format_short(part)}"
    if isinstance(part, str) and any(detail["type"] == "node" for detail in errors):
        return f"{sentence}: an option is chosen with a slash, {f'{key}{path}'.replace('.', '/')}={part}"
    choices = [str(choice) for choice in get_args(annotation)] if get_origin(annotation) is Literal else []
    return f"{sentence}{suggestion(str(part), choices)}"


def _part_at(value: Any, location: Sequence[int | str]) -> tuple[str, Any]:
    """Return dotted path and part of a value at pydantic's `location`, which also names members of unions."""
    path = ""
    for key in location:
        if isinstance(value, dict) and key in value:
            path, value = f"{path}.{key}", value[key]
        elif isinstance(value, list) and isinstance(key, int) and key < len(value):
            path, value = f"{path}[{key}]", value[key]
    return path, value


def format_short(value: Any) -> str:
    """Format a plain value in at most 200 characters."""
    text = json.dumps(value) if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 200 else f"{text[:200]}…"


@cache
def _adapter(annotation: Any) -> TypeAdapter[Any]:
    return TypeAdapter(_convert(annotation), config=ConfigDict(allow_inf_nan=False))


def _convert(annotation: Any) -> Any:
    """Convert `annotation` for pydantic's validation of JSON: classes become nodes, sequences become lists."""
    kind, arguments = get_origin(annotation), get_args(annotation)
    if annotation in SCALARS or annotation is None or kind is Literal:
        return annotation
    if kind is Annotated:
        constraints = (_validator(item) if isinstance(item, Predicate) else item for item in arguments[1:])
        return Annotated[(_convert(arguments[0]), *constraints)]  # type: ignore[invalid-annotation]
    if kind in (Union, types.UnionType):
        return Union[tuple(map(_convert, arguments))]  # type: ignore[invalid-annotation]  # noqa: UP007
    if (kind or annotation) in PATHS:
        return Annotated[str, MinLen(1)]
    if kind is tuple:
        return tuple[tuple(item if item is Ellipsis else _convert(item) for item in arguments)]  # type: ignore[misc]
    if (kind or annotation) in SEQUENCES:
        return list[_convert(arguments[0]) if arguments else Any]  # type: ignore[misc]
    if (kind or annotation) in MAPPINGS:
        return dict[str, _convert(arguments[1]) if arguments else Any]  # type: ignore[misc]
    if annotation is object:  # the caller validates it
        return Any
    if annotation in (Any, inspect.Parameter.empty) or isinstance(annotation, TypeVar):
        return Annotated[Any, BeforeValidator(_require_plain)]
    if getattr(kind, "__name__", "") == "Callable":
        return Annotated[Any, BeforeValidator(lambda value: _require_node(value, arguments[1], partial=True))]
    return Annotated[Any, BeforeValidator(lambda value: _require_node(value, annotation, partial=False))]


def _validator(predicate: Predicate) -> AfterValidator:
    """Convert a predicate, whose docstring completes "must be …"."""

    def checked(value: Any) -> Any:
        if not predicate.func(value):
            raise PydanticCustomError("predicate", str(predicate.func.__doc__))  # type: ignore[bad-argument-type]
        return value

    return AfterValidator(checked)


def _require_plain(value: Any) -> Any:
    if is_node(value):
        raise PydanticCustomError("plain", "a plain value without a _target_")
    if isinstance(value, float) and not isfinite(value):
        raise PydanticCustomError("plain", "finite")
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _require_plain(part)
    return value


def _require_node(value: Any, expected: Any, partial: bool) -> Any:
    matches = is_node(value) and bool(value.get("_partial_")) is partial
    if not matches or not fits(locate("_target_", value["_target_"]), expected):
        name: Any = f"{'a factory of ' if partial else ''}{getattr(expected, '__name__', expected)}"
        raise PydanticCustomError("node", name)
    return value
