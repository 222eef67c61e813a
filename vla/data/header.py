"""Description of an episode store, `store.json`: the layout of its rows and the config that produced them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from vla.data.index import REMEDY, JsonObject, dumps
from vla.io.documents import STRICT, parse_json, parse_plain, read_bounded, resolve_config
from vla.io.errors import UserError
from vla.io.files import write_text
from vla.io.types import Images, Quality
from vla.spec import Spec

FORMAT = 3
NAME = "store.json"
MAX_HEADER_BYTES = 16 << 20  # a derived store of a thousand others has 5 MB
LARGEST_RAW = 128  # height and width of the images that are stored raw unless asked otherwise [px]


@dataclass(frozen=True)
class Codec:
    """How a store encodes its images. Depth is never lossy: it is lossless where colour is JPEG."""

    __pydantic_config__ = STRICT

    images: Images = "raw"
    quality: Quality | None = None  # of JPEG

    @classmethod
    def for_spec(cls, spec: Spec) -> Codec:
        """Return the codec for images of the size in `spec`: raw up to `LARGEST_RAW`, beyond it lossless."""
        return cls("raw" if max(spec.image_size) <= LARGEST_RAW else "lossless")

    def __str__(self) -> str:
        """Describe the images."""
        return f"{self.images} images" + (f" of quality {self.quality}" if self.quality else "")

    @property
    def loss(self) -> Codec:
        """The lossy part of the codec, equal for codecs that decode to the same images."""
        return self if self.images == "jpeg" else RAW

    def of_field(self, field: str) -> Images:
        """Return the codec of a field."""
        kind = field.partition("_")[0]
        if kind not in ("rgb", "depth"):
            return "raw"
        return "lossless" if kind == "depth" and self.images == "jpeg" else self.images


RAW = Codec()


@dataclass(frozen=True)
class DerivedConfig:
    """Config of a store that was derived from others."""

    __pydantic_config__ = STRICT

    parts: list[tuple[JsonObject, Annotated[int, Ge(1), Le(2**53)]]]  # a config, and how many entries in a row have it
    where: list[JsonObject]  # the filters that were applied, in order


@dataclass(frozen=True)
class Header:
    """Content of `store.json`; `spec` is `Spec.to_dict()`."""

    __pydantic_config__ = STRICT

    format: int
    spec: Any
    config: JsonObject  # of task and expert, or `DerivedConfig`
    fields: Any  # field → shape and dtype of a row
    codec: Codec = RAW  # of the images; not written if they are raw


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


def is_store(folder: Path) -> bool:
    """Return whether a folder holds an episode store, which may be empty or damaged."""
    return (folder / NAME).exists()


def read_header(folder: Path) -> tuple[Header, Spec]:
    """Read the description of the store in a folder; a UserError if it is missing, damaged or of another kind."""
    path = folder / NAME
    if not is_store(folder):
        raise UserError(f"there is no episode store in {folder} (no {NAME}): collect one first, with job=collect")
    try:
        content = read_bounded(path, MAX_HEADER_BYTES)
        version = parse_json(content, dict[str, Any], str(path)).get("format")
        if version == FORMAT:
            return _parse(content, path)
    except UserError as error:
        raise UserError(f"{error}: {REMEDY}") from error
    raise UserError(f"{path} has format {str(version)[:20]}, this version reads {FORMAT}: collect again")


def _parse(content: bytes, path: Path) -> tuple[Header, Spec]:
    header = parse_json(content, Header, str(path))
    spec = Spec.from_dict(header.spec, f"{path}: spec")
    if "parts" in header.config:
        parse_plain(header.config, DerivedConfig, f"{path}: config")
    resolve_config(header.config, str(path))
    has_quality = header.codec.quality is not None
    if header.fields != _layouts(spec) or has_quality != (header.codec.images == "jpeg"):
        raise UserError(f"{path} is damaged or of another kind: its fields are not those of its spec and codec")
    return header, spec


def write_header(folder: Path, spec: Spec, config: dict[str, Any], codec: Codec) -> None:
    """Write the description of a store unless it exists: another process may have been faster.

    Raises:
        UserError: the folder holds episodes without a description.
        OSError: it cannot be written.
    """
    if is_store(folder):
        return
    orphans = sorted(file.name for file in folder.iterdir() if file.suffix in (".bin", ".pack", ".jsonl"))
    if orphans:
        raise UserError(f"{folder} holds {orphans[0]} without {NAME}, which describes it: {REMEDY}")
    content = asdict(Header(FORMAT, spec.to_dict(), config, _layouts(spec), codec))
    if codec == RAW:
        del content["codec"]
    write_text(folder / NAME, dumps(content))


def _layouts(spec: Spec) -> dict[str, dict[str, Any]]:
    return {name: {"shape": [*shape], "dtype": dtype.name} for name, (shape, dtype) in fields_of(spec).items()}
