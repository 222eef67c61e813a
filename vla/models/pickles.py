"""Tensors in the pickles of PyTorch, read as data."""

from __future__ import annotations

from io import BytesIO
from pickle import UnpicklingError
from pickletools import genops
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import torch
from torch import Tensor

# What a pickle may name.
KNOWN = (
    *("collections OrderedDict", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"),
    *(f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16", "Bool", "Byte")),
    *(f"torch {kind}Storage" for kind in ("Char", "Short", "Int", "Long")),
)
ZIP = b"PK\x03\x04"  # by which PyTorch tells the formats apart
OLD_PICKLES = 5  # before the numbers in a file of PyTorch before 1.6, which is no zip archive


def load_tensors(content: bytes) -> Any:
    """Read a file of `torch.save`, in the format of today or in that of PyTorch before 1.6.

    Raises:
        Exception: it is damaged, or holds something else than tensors; a pickle can raise nearly anything.
    """
    file = BytesIO(content)
    if content.startswith(ZIP):
        require_tensor_archive(file, len(content), checksums=True)
    else:
        for _ in range(OLD_PICKLES):
            _require_known(file)
    file.seek(0)
    loaded = torch.load(file, map_location="cpu", weights_only=True)
    require_stored(loaded, len(content))
    return loaded


def require_tensor_archive(file: BinaryIO, size: int, checksums: bool) -> None:
    """Require a zip archive of `size` [bytes] to hold no more than that, and tensors only.

    Args:
        checksums: also verify the numbers, by reading them.

    Raises:
        BadZipFile: it is damaged, or not as PyTorch writes it.
        UnpicklingError: its pickle names something else.
    """
    if file.read(len(ZIP)) != ZIP:
        raise BadZipFile("something precedes the archive, which PyTorch would read instead")
    with ZipFile(file) as archive:
        entries = archive.infolist()
        # torch does not compress, so content larger than the file is an attack on the memory.
        packed = any(entry.compress_type != ZIP_STORED for entry in entries)
        if packed or sum(entry.file_size for entry in entries) > size:
            raise BadZipFile("its parts are compressed or overlap")
        for entry in entries:
            if checksums or entry.filename.endswith("/data.pkl"):
                _verify(archive, entry)  # torch does not verify checksums
            if entry.filename.endswith("/data.pkl"):
                _require_known(BytesIO(archive.read(entry)))


def require_stored(content: Any, size: int) -> None:
    """Require the tensors to lie in a file of `size` [bytes]: strides of 0 describe any number of elements.

    Raises:
        UnpicklingError: a tensor is larger than its storage, or all storages together are larger than the file.
    """
    pending, seen, stored = [content], set[int](), dict[int, int]()
    while pending:
        value = pending.pop()
        if isinstance(value, Tensor):
            storage = value.untyped_storage()
            stored[storage.data_ptr()] = storage.nbytes()
            if value.nbytes > storage.nbytes():
                raise UnpicklingError("a tensor is larger than its storage")
        elif isinstance(value, (dict, list, tuple)) and id(value) not in seen:
            seen.add(id(value))  # a pickle can refer to the same list many times, or to itself
            pending += [*value, *value.values()] if isinstance(value, dict) else value
    if sum(stored.values()) > size:
        raise UnpicklingError("its tensors are larger than the file")


def _require_known(pickled: BinaryIO) -> None:
    """Require that the next pickle in a file names nothing but `KNOWN`, the constructors of tensors, and read it fully.

    PyTorch by itself also lets a pickle call `bytearray(10**10)`, for example.

    Raises:
        UnpicklingError: it names something else.
    """
    for opcode, name, _ in genops(pickled):
        if opcode.name == "GLOBAL" and name not in KNOWN:
            raise UnpicklingError(f"it names {name}")


def _verify(archive: ZipFile, entry: ZipInfo) -> None:
    """Read an entry to its end, where zipfile verifies the checksum; raises BadZipFile if it differs."""
    with archive.open(entry) as part:
        while part.read(2**20):
            pass
