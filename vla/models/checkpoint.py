"""Lightning's checkpoints, which serve only to resume the training that wrote them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import torch

from vla.io.documents import resolve_config
from vla.io.errors import UserError


class Header(NamedTuple):
    """Metadata of a checkpoint."""

    config: dict[str, Any]  # of the training
    finished: bool  # the training was completed
    steps: int  # optimiser steps


def read_header(path: Path) -> Header:
    """Read the metadata of a checkpoint, in a time that does not depend on its size. Raises as `read_content`."""
    content = read_content(path, weights=False)
    config, steps = resolve_config(content.get("config"), f"the configuration in {path}"), content.get("global_step")
    if not isinstance(config, dict) or not isinstance(steps, int):
        raise UserError(f"{path} is no checkpoint of this project: it carries no configuration, or no steps")
    return Header(config, content.get("finished") is True, steps)


def read_content(path: Path, weights: bool = True) -> dict[str, Any]:
    """Read a checkpoint as plain values and tensors on the CPU; without `weights`, the data of tensors is not read.

    Raises:
        UserError: there is no file, or it is damaged or no checkpoint.
        OSError: the file cannot be read.
    """
    if not path.is_file():
        raise UserError(f"there is no checkpoint {path}")
    try:
        with ZipFile(path) as archive:
            # PyTorch compresses nothing, and what is compressed could be larger than the memory.
            if any(entry.compress_type != ZIP_STORED for entry in archive.infolist()):
                raise BadZipFile(f"{path} is compressed")
            if weights and (part := archive.testzip()):  # PyTorch ignores the checksums that it writes
                raise BadZipFile(part)
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=not weights)
    except OSError:
        raise
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise UserError(f"{path} cannot be read as a checkpoint: it is damaged or of another kind") from error
    return content if isinstance(content, dict) else {}


def weights_of(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of the model in a checkpoint: the EMA weights, and buffers and extra state of its modules."""
    prefix = "model."
    return {key[len(prefix) :]: value for key, value in content["state_dict"].items() if key.startswith(prefix)}
