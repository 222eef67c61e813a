"""Description of an episode store, `store.json`: the layout of its rows and the config that produced them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from vla.data.index import REMEDY, Plain, dumps
from vla.io.documents import STRICT, parse_json, parse_plain, read_bounded, resolved
from vla.io.files import write_text
from vla.spec import Spec

FORMAT = 3
NAME = "store.json"
LARGEST = 16 << 20  # [bytes]; a derived store of a thousand others has 5 MB

Codec = Literal["jpeg", "zlib"]


@dataclass(frozen=True)
class Layout:
    """Layout of one row of a field."""

    __pydantic_config__ = STRICT

    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class Part:
    """Consecutive entries of one config."""

    __pydantic_config__ = STRICT

    config: Plain
    entries: Annotated[int, Ge(1), Le(2**53)]


@dataclass(frozen=True)
class Derived:
    """Config of a store that was derived from others."""

    __pydantic_config__ = STRICT

    parts: list[Part]
    where: list[Plain]  # the filters that were applied, in order


@dataclass(frozen=True)
class Header:
    """Content of `store.json`; `spec` is `Spec.to_dict()`."""

    __pydantic_config__ = STRICT

    format: int
    spec: Any
    config: Plain  # of task and expert, or `Derived`
    fields: dict[str, Layout]
    packed: dict[str, Codec] = field(default_factory=dict)  # field of packed images → codec
    quality: Annotated[int, Ge(1), Le(95)] | None = None  # of JPEG

    def text(self) -> str:
        """Return the content of the file."""
        return dumps(
            {name: value for name, value in asdict(self).items() if value not in ({}, None) or name == "config"}
        )


def fields_of(spec: Spec) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return field name → shape and dtype of one row."""
    sizes = {"state": len(spec.state), "action": len(spec.action), "executed": len(spec.action)}
    if spec.truth:
        sizes["truth"] = spec.truth_size
    return {
        **{f"rgb_{camera}": ((*spec.image_size, 3), np.dtype(np.uint8)) for camera in spec.cameras},
        **{f"depth_{camera}": (spec.image_size, np.dtype("<u2")) for camera in spec.depth},
        **{name: ((size,), np.dtype("<f4")) for name, size in sizes.items()},
    }


def images_of(spec: Spec) -> list[str]:
    """Return the names of the image fields."""
    return [*(f"rgb_{camera}" for camera in spec.cameras), *(f"depth_{camera}" for camera in spec.depth)]


def is_store(folder: Path) -> bool:
    """Return whether a folder holds an episode store, which may be empty or damaged."""
    return (folder / NAME).exists()


def read_header(folder: Path) -> tuple[Header, Spec]:
    """Read the description of the store in a folder.

    Raises:
        ValueError: it is missing, damaged or of another kind.
    """
    path = folder / NAME
    if not is_store(folder):
        raise ValueError(f"there is no episode store in {folder} (no {NAME}): collect one first, with job=collect")
    try:
        content = read_bounded(path, LARGEST)
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
        parse_plain(header.config, Derived, f"{path}: config")
    resolved(header.config, str(path))
    if header.fields != _layouts(spec) or (header.packed and set(header.packed) != set(images_of(spec))):
        raise ValueError(f"{path} is damaged or of another kind: its fields are not those of its spec")
    return header, spec


def write_header(folder: Path, spec: Spec, config: dict[str, Any]) -> None:
    """Write the description of an unpacked store unless it exists: another process may have been faster.

    Raises:
        ValueError: the folder holds episodes without a description.
        OSError: it cannot be written.
    """
    path = folder / NAME
    if is_store(folder):
        return
    orphans = sorted(file.name for file in folder.iterdir() if file.suffix in (".bin", ".jsonl"))
    if orphans:
        raise ValueError(f"{folder} holds {orphans[0]} without {NAME}, which says what it means: {REMEDY}")
    write_text(path, Header(FORMAT, spec.to_dict(), config, _layouts(spec)).text())


def _layouts(spec: Spec) -> dict[str, Layout]:
    return {name: Layout(shape, dtype.name) for name, (shape, dtype) in fields_of(spec).items()}
