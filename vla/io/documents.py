"""Untrusted JSON and YAML files: bounded in size and depth, and validated against a type."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import yaml
from pydantic import ConfigDict, PydanticUserError, StringConstraints, TypeAdapter, ValidationError

from vla.io.errors import UserError
from vla.io.files import require_file

T = TypeVar("T")

MAX_BYTES = 64 << 20  # [bytes] of a file
MAX_YAML_BYTES = 1 << 20  # [bytes] of a YAML file, which is slow to parse
MAX_RESOLVED_BYTES = 4 << 20  # [bytes] of a configuration, which takes thirty times as much memory before it is counted
MAX_VALUES = 100_000  # values in a configuration
LONG_NUMBER = re.compile(r"[-+.:\d_]{100,}")  # in base 60, 1:1:1:…, a megabyte takes minutes
MAX_DEPTH = 64  # nesting levels in YAML; pydantic's JSON parser stops at 200 by itself

# `__pydantic_config__` of the dataclasses and typed dictionaries that describe a file; LENIENT ones may have further
# keys, such as derived values, or those of other programs.
STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
LENIENT = ConfigDict(STRICT, extra="ignore")
SHA256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


def read_json(path: Path, kind: type[T], max_bytes: int = MAX_BYTES) -> T:
    """Read the JSON file at `path` as a `kind`: a dataclass, a typed dictionary or any annotation.

    Raises an OSError if it cannot be read, and a UserError if it is larger than `max_bytes`, nested too deep, not JSON,
    or not of that kind.
    """
    return parse_json(read_bounded(path, max_bytes), kind, str(path))


def read_yaml(path: Path, kind: type[T]) -> T:
    """Read the YAML file at `path` as a `kind`, see `read_json`. Aliases are refused: they expand without bound."""
    text = read_bounded(path, MAX_YAML_BYTES)
    try:
        _require_shallow(text)
        json_text = json.dumps(yaml.load(text, Loader=yaml.CSafeLoader))
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:  # ValueError: also an impossible date
        raise UserError(f"{path} is no plain YAML: {' '.join(str(error).split())[:200]}") from error
    return parse_json(json_text, kind, str(path))


def parse_json(text: str | bytes, kind: type[T], name: str) -> T:
    """Parse JSON text, called `name` in errors, as a `kind`, see `read_json`."""
    try:
        value: T = _adapter(cast(Any, kind)).validate_json(text, strict=True)
    except ValidationError as error:
        raise UserError(f"{name} is damaged or of another kind: {_problems(error)}") from error
    return value


def parse_plain(value: Any, kind: type[T], name: str) -> T:
    """Validate a plain value, called `name` in errors, such as a part of a checkpoint, as a `kind`, see `read_json`."""
    try:
        text = json.dumps(value)
    except (TypeError, ValueError, RecursionError) as error:
        raise UserError(f"{name} is damaged or of another kind: {str(error)[:200]}") from error
    return parse_json(text, kind, name)


def lines_of(error: BaseException) -> list[str]:
    """Return the lines of an error's message, or its type if it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()


def _require_shallow(text: bytes) -> None:
    """Raise a ValueError unless YAML text has at most `MAX_DEPTH` levels, and neither aliases nor long numbers."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        is_long_number = isinstance(event, yaml.ScalarEvent) and LONG_NUMBER.fullmatch(event.value)
        if depth > MAX_DEPTH or is_long_number or isinstance(event, yaml.AliasEvent):
            raise ValueError(f"nested deeper than {MAX_DEPTH} levels, or with aliases or numbers of 100 digits")


def resolve_config(value: Any, name: str) -> Any:
    """Return a copy of a configuration from a file, called `name`: dicts with texts as keys, lists, and plain values.

    Raises a UserError if a value is no mapping, list, text, finite number or null; a key is no text; a text contains
    `${`, which would be resolved later; or there are more than `MAX_VALUES` values or `MAX_DEPTH` levels.
    """
    # Exact types, because a checkpoint's pickle can make a mapping whose methods hide what it holds.
    count = itertools.count(1)

    def copy_of(item: Any, depth: int) -> Any:
        if next(count) > MAX_VALUES or depth > MAX_DEPTH:  # a file can refer to a list many times, or to itself
            raise UserError(f"{name} holds more than {MAX_VALUES} values, or more than {MAX_DEPTH} levels of them")
        if type(item) in (list, tuple):
            return [copy_of(part, depth + 1) for part in item]
        if type(item) is dict:
            if other_keys := [key for key in item if type(key) is not str]:
                raise UserError(f"{name} holds the key {str(other_keys[0])[:200]}, which is no text")
            return {copy_of(key, depth + 1): copy_of(part, depth + 1) for key, part in item.items()}
        if type(item) is str and "${" in item:
            raise UserError(f"{name} holds the reference {item[:200]!r}: only resolved values are read from files")
        if item is not None and type(item) not in (bool, int, float, str):
            raise UserError(f"{name} holds a {type(item).__name__}, which is no plain data")
        if type(item) is float and not isfinite(item):  # as 1e999 is
            raise UserError(f"{name} holds {item}, which is not finite")
        return item

    return copy_of(value, 0)


def read_resolved(path: Path) -> Any:
    """Read the JSON file at `path` as a configuration, see `resolve_config`.

    Also raises a UserError if a key occurs twice, or a text has a lone surrogate, which could not be written again.
    """

    def unique_mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(mapping := dict(pairs)) < len(pairs):
            raise UserError("a mapping has one key twice")
        return mapping

    try:
        text = read_bounded(path, MAX_RESOLVED_BYTES)
        value = json.loads(text, object_pairs_hook=unique_mapping, parse_constant=int)  # int("NaN") raises a ValueError
        json.dumps(value, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is damaged or of another kind: {str(error)[:200]}") from error
    return resolve_config(value, str(path))


def mappings(value: Any) -> Iterator[dict[Any, Any]]:
    """Yield all mappings in a plain value, outer ones first."""
    if isinstance(value, dict):
        yield value
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from mappings(part)


def canonicalize(value: Any) -> Any:
    """Return a plain value without keys whose value is null, at every level, and with integral floats as integers."""
    if isinstance(value, dict):
        return {name: canonicalize(item) for name, item in value.items() if item is not None}
    if isinstance(value, list):
        return [canonicalize(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _problems(error: ValidationError) -> str:
    """Format the first three validation errors, as `spec.cameras[0]: Input should be a valid string`."""
    messages = []
    for item in error.errors(include_url=False, include_input=False):
        path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in item["loc"])
        messages.append(f"{path.lstrip('.')[:100]}: {item['msg']}" if path else item["msg"])
    rest = [f"and {len(messages) - 3} more"] if len(messages) > 3 else []
    return "; ".join([*messages[:3], *rest])


def read_bounded(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a file of at most `max_bytes` bytes, see `read_json`."""
    require_file(path)
    size = path.stat().st_size
    if size > max_bytes:
        raise UserError(f"{path} has {size} bytes, more than the {max_bytes} that such a file can have")
    return path.read_bytes()


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    try:
        return TypeAdapter(kind, config=ConfigDict(allow_inf_nan=False))
    except PydanticUserError:  # a dataclass or typed dictionary has its own configuration
        return TypeAdapter(kind)
