"""The description of an episode store, `store.json`: what its rows mean and what made them."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from vla.data.index import REMEDY, Plain, dumps
from vla.documents import STRICT, parse_json, require_resolved
from vla.spec import Spec

FORMAT = 2
NAME = "store.json"

Codec = Literal["jpeg", "zlib"]


@dataclass(frozen=True)
class Layout:
    """The row that one step leaves in the file of a field."""

    __pydantic_config__ = STRICT

    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class Part:
    """So many consecutive entries of one config."""

    __pydantic_config__ = STRICT

    config: Plain
    entries: Annotated[int, Ge(1), Le(2**53)]


@dataclass(frozen=True)
class Derived:
    """The config of a store that was put together from others."""

    __pydantic_config__ = STRICT

    parts: list[Part]
    where: list[Plain]  # the conditions by which the episodes were chosen, one after the other


@dataclass(frozen=True)
class Header:
    """What `store.json` says; `spec` is one of `Spec`."""

    __pydantic_config__ = STRICT

    format: int
    spec: Any
    config: Plain  # what made the episodes, or `Derived`
    fields: dict[str, Layout]
    packed: dict[str, Codec] = field(default_factory=dict)  # field of packed images → codec
    quality: Annotated[int, Ge(1), Le(95)] | None = None  # of JPEG

    def text(self) -> str:
        """The content of the file."""
        return dumps(
            {name: value for name, value in asdict(self).items() if value not in ({}, None) or name == "config"}
        )


def fields_of(spec: Spec) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Field name → shape and dtype of the row that one step leaves there."""
    joints, action, numbers = len(spec.joints), len(spec.action), np.dtype("<f4")
    sizes = {"joints": joints, "velocities": joints, "gripper": 1, "action": action, "executed": action}
    if spec.truth:
        sizes["truth"] = spec.truth_size
    fields: dict[str, tuple[tuple[int, ...], np.dtype]] = {}
    for camera in spec.cameras:
        fields[f"rgb_{camera}"] = ((*spec.image_size, 3), np.dtype(np.uint8))
        fields[f"depth_{camera}"] = (spec.image_size, np.dtype("<u2"))
    return fields | {name: ((size,), numbers) for name, size in sizes.items()}


def header_of(spec: Spec, config: dict[str, Any]) -> Header:
    """The description of a store that is not packed."""
    return Header(FORMAT, spec.to_dict(), config, _layouts(spec))


def read_header(folder: Path) -> tuple[Header, Spec]:
    """The description of the store in a folder.

    Raises:
        ValueError: there is none, or it is damaged or of another kind.
    """
    path = folder / NAME
    if not path.exists():
        raise ValueError(f"there is no episode store in {folder} (no {NAME}): collect one first, with job=collect")
    try:
        content = path.read_bytes()
        found = parse_json(content, dict[str, Any], str(path)).get("format")
        if found == FORMAT:
            return _parsed(content, path)
    except ValueError as error:
        raise ValueError(f"{error}: {REMEDY}") from error
    raise ValueError(f"{path} has format {str(found)[:20]}, this version reads {FORMAT}: collect again")


def _parsed(content: bytes, path: Path) -> tuple[Header, Spec]:
    header = parse_json(content, Header, str(path))
    spec = Spec.from_dict(header.spec, f"{path}: spec")
    if "parts" in header.config:
        parse_json(json.dumps(header.config), Derived, f"{path}: config")
    require_resolved(header.config, str(path))
    images = {f"{kind}_{camera}" for kind in ("rgb", "depth") for camera in spec.cameras}
    if header.fields != _layouts(spec) or (header.packed and set(header.packed) != images):
        raise ValueError(f"{path} is damaged or of another kind: its fields are not those of its spec")
    return header, spec


def write_header(folder: Path, header: Header) -> None:
    """Write the description, unless there is one: another process may have been faster.

    Raises:
        ValueError: episodes lie there without one, or the disk is full.
    """
    path = folder / NAME
    if path.exists():
        return
    orphans = sorted(file.name for file in folder.iterdir() if file.suffix in (".bin", ".jsonl"))
    if orphans:
        raise ValueError(f"{folder} holds {orphans[0]} without {NAME}, which says what it means: {REMEDY}")
    draft = folder / f"{NAME}.draft"
    try:
        draft.write_text(header.text(), encoding="utf-8")
    except OSError as error:
        raise ValueError(
            f"{folder} cannot take a store ({error.strerror}): make room there, or set collect.folder"
        ) from error
    os.replace(draft, path)


def _layouts(spec: Spec) -> dict[str, Layout]:
    return {name: Layout(shape, dtype.name) for name, (shape, dtype) in fields_of(spec).items()}
