"""Plain values and tensors in the files of `torch.save`, read as data.

PyTorch's reader of untrusted files also calls what it allows with any arguments, lets mappings hide their methods, and
takes sizes and names of the archive as the file claims them. Here no class and no function comes out of a file: the
instructions of a pickle make dicts, lists, tuples, texts, numbers and tensors, of exactly these types.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from math import prod
from pickle import UnpicklingError
from pickletools import genops
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import torch
from torch import Tensor

# What a pickle may name: the types of numbers, and what makes mappings and tensors.
TYPES = {
    **{"Float": torch.float32, "Double": torch.float64, "Half": torch.float16, "BFloat16": torch.bfloat16},
    **{"Bool": torch.bool, "Byte": torch.uint8, "Char": torch.int8, "Short": torch.int16},
    **{"Int": torch.int32, "Long": torch.int64},
}
STORAGES = {f"torch {name}Storage": dtype for name, dtype in TYPES.items()}
MAPPING = "collections OrderedDict"
TENSOR, PARAMETER = "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"
KNOWN = (*STORAGES, MAPPING, TENSOR, PARAMETER)

EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
# The values that instructions take from the stack; others take those since the last mark.
TAKEN = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3, "APPEND": 1, "SETITEM": 2, "REDUCE": 2}
LITERALS = ("GLOBAL", "BINUNICODE", "BINFLOAT", "BININT", "BININT1", "BININT2", "LONG1")

ZIP = b"PK\x03\x04"  # begins an archive; files of PyTorch before 1.6 are none
LARGEST = 8 << 20  # of its pickle [bytes], of which every one may make an object; that of a training has less than 1 MB
OLD_PICKLES = 3  # before the content of such a file

# (name of the type, key, number of elements) → a tensor of all elements, (N,)
Storage = Callable[[str, str, int], Tensor]


def load_tensors(content: bytes) -> Any:
    """Read a file of `torch.save`, in the format of today or in that of PyTorch before 1.6.

    Raises:
        Exception: it is damaged, or holds something else than plain values and tensors.
    """
    file = BytesIO(content)
    return read_archive(file, len(content)) if content.startswith(ZIP) else _read_old(file, len(content))


def read_archive(file: BinaryIO, size: int, numbers: bool = True) -> Any:
    """Read an archive of `size` [bytes], whose checksums are verified.

    Args:
        file: at its beginning.
        size: of the file [bytes].
        numbers: read the tensors too; else they have no numbers, on PyTorch's device "meta".

    Raises:
        Exception: it is damaged, or holds something else than plain values and tensors.
    """
    if file.read(len(ZIP)) != ZIP:
        raise BadZipFile("something precedes the archive")
    with ZipFile(file) as archive:
        parts = archive.infolist()
        # torch does not compress, so content larger than the file is an attack on the memory.
        if any(part.compress_type != ZIP_STORED for part in parts) or sum(part.file_size for part in parts) > size:
            raise BadZipFile("its parts are compressed or overlap")
        entries = {part.filename.partition("/")[2]: part for part in parts}
        if entries["data.pkl"].file_size > LARGEST:
            raise BadZipFile(f"its pickle has more than {LARGEST} bytes")
        if "byteorder" in entries and archive.read(entries["byteorder"]) != b"little":
            raise BadZipFile("its numbers are in another order of bytes")
        read: dict[str, Tensor] = {}

        def storage(kind: str, key: str, count: int) -> Tensor:
            entry, dtype = entries[f"data/{key}"], STORAGES[kind]
            if entry.file_size != count * dtype.itemsize:
                raise UnpicklingError("a storage has another size than the archive says")
            if key not in read:
                meta = torch.empty(entry.file_size, dtype=torch.uint8, device="meta")
                read[key] = _bytes(archive.read(entry)) if numbers else meta
            return read[key].view(dtype)

        return _interpreted(BytesIO(archive.read(entries["data.pkl"])), storage)


def _bytes(data: bytes) -> Tensor:
    return torch.frombuffer(bytearray(data), dtype=torch.uint8) if data else torch.empty(0, dtype=torch.uint8)


def _read_old(file: BinaryIO, size: int) -> Any:
    """Read a file of PyTorch before 1.6: the numbers follow the pickles, which name them."""
    storages: dict[str, Tensor] = {}

    def allocated(kind: str, key: str, count: int) -> Tensor:
        dtype = STORAGES[kind]
        if key not in storages:
            if count * dtype.itemsize + sum(each.nbytes for each in storages.values()) > size:
                raise UnpicklingError("its tensors are larger than the file")
            storages[key] = torch.empty(count, dtype=dtype)
        return storages[key]

    for _ in range(OLD_PICKLES):
        _interpreted(file, allocated)
    content, keys = _interpreted(file, allocated), _interpreted(file, allocated)
    for key in keys:
        target = storages.pop(key)
        if int.from_bytes(file.read(8), "little") != len(target):
            raise UnpicklingError("a storage has another size than its pickle says")
        target.view(torch.uint8).copy_(_bytes(file.read(target.nbytes)))
    if storages:
        raise UnpicklingError("it lacks numbers")
    return content


def _interpreted(pickled: BinaryIO, storage: Storage) -> Any:
    """Return the value of the next pickle in a file, up to its last instruction.

    Raises:
        UnpicklingError: it names something else than `KNOWN`, or has an instruction that torch does not write.
    """
    stack, marks, memo = list[Any](), list[int](), dict[Any, Any]()

    def taken(instruction: str) -> list[Any]:
        """Take as many values from the stack as an instruction does, or those since the last mark."""
        first = len(stack) - TAKEN[instruction] if instruction in TAKEN else marks.pop()
        items, stack[first:] = stack[first:], []
        return items

    for opcode, argument, _ in genops(pickled):
        name = opcode.name
        if name == "GLOBAL" and argument not in KNOWN:
            raise UnpicklingError(f"it names {argument}")
        if name in LITERALS:
            stack.append(argument)
        elif name in CONSTANTS or name in EMPTY:
            stack.append(EMPTY[name]() if name in EMPTY else CONSTANTS[name])
        elif name == "MARK":
            marks.append(len(stack))
        elif name in ("BINPUT", "LONG_BINPUT"):
            memo[argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name.startswith("TUPLE"):
            stack.append(tuple(taken(name)))
        elif name in ("APPEND", "APPENDS", "SETITEM", "SETITEMS"):
            _fill(taken(name), stack[-1], dict if name.startswith("SET") else list)
        elif name == "BINPERSID":
            stack.append(_numbers(storage, *stack.pop()))
        elif name == "REDUCE":
            stack.append(_made(*taken(name)))
        elif name == "BUILD" and type(stack[-2]) is type(stack[-1]) is dict and [*stack[-1]] == ["_metadata"]:
            stack.pop()  # versions of the modules in a state
        elif name not in ("PROTO", "STOP"):
            raise UnpicklingError(f"it has the instruction {name}")
    return stack.pop()


def _fill(items: list[Any], target: Any, kind: type) -> None:
    """Add items to a list, or keys and values to a dict."""
    keys, values = items[::2], items[1::2]
    if type(target) is not kind or (kind is dict and not all(type(key) in (str, int) for key in keys)):
        raise UnpicklingError("what is no list or mapping gets items, or a key is no text and no whole number")
    if kind is dict:
        target.update(zip(keys, values, strict=True))
    else:
        target += items


def _numbers(storage: Storage, kind: str, name: str, key: str, device: str, count: int, part: Any = None) -> Tensor:
    """Return the numbers that a pickle refers to; other kinds and parts of other numbers are not written any more."""
    if kind != "storage" or part is not None:
        raise UnpicklingError("it refers to something else than numbers")
    return storage(name, key, count)


def _made(name: Any, arguments: Any) -> Any:
    """Return the value of a call: an empty mapping, or a tensor within its storage.

    Raises:
        UnpicklingError: it is something else.
    """
    if type(arguments) is tuple:
        if name == MAPPING and not arguments:
            return {}
        if name == PARAMETER and isinstance(arguments[0], Tensor):
            return arguments[0]
        if name == TENSOR:
            numbers, offset, size, stride, *_ = arguments
            counts = (offset, *size, *stride)
            if isinstance(numbers, Tensor) and all(type(each) is int and 0 <= each < 2**63 for each in counts):
                if len(size) > 64 or prod(size) > numbers.numel():  # strides of 0 describe any number of elements
                    raise UnpicklingError("a tensor is larger than its storage")
                return numbers.as_strided(size, stride, offset)
    raise UnpicklingError("it calls something else than what makes tensors")
