"""Files of `torch.save` as data: what torch writes is read as torch reads it, and nothing else is."""

from __future__ import annotations

import io
import struct
from collections import OrderedDict
from collections.abc import Callable
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile

import pytest
import torch
from crafted import Hiding
from torch import Tensor, nn

from vla.models.pickles import load_tensors, read_archive

DTYPES = (
    *(torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.bool),
    *(torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
)


def content() -> dict[str, Any]:
    """All that a checkpoint of Lightning is made of."""
    shared = torch.arange(12.0).reshape(3, 4)
    module = nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3))
    return {
        "numbers": [0, -1, 255, 70_000, 2**40, -(2**70), 0.5, True, False, None, "ü", ""],
        "nested": {"a": [(), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), [], {}, {"b": OrderedDict(c=1)}], 5: {6: 7}},
        "dtypes": {str(dtype): torch.ones(3).to(dtype) for dtype in DTYPES},
        "state_dict": module.state_dict(),  # with attributes
        "views": [shared, shared.T, shared[1:, ::2], shared[0, 0], torch.empty(0, 3), torch.tensor(3)],
        "parameter": nn.Parameter(torch.ones(2)),
        "optimizer": torch.optim.AdamW(module.parameters()).state_dict(),
    }


def saved(value: Any, **options: Any) -> bytes:
    file = io.BytesIO()
    torch.save(value, file, **options)
    return file.getvalue()


def require_equal(found: Any, expected: Any) -> None:
    """Require equal values of plain types."""
    if isinstance(expected, Tensor):
        assert type(found) is Tensor and found.dtype == expected.dtype and torch.equal(found, expected)
        assert found.stride() == expected.stride()
    elif isinstance(expected, dict):
        assert type(found) is dict and list(found) == list(expected)
        for key, value in dict.items(found):
            require_equal(value, expected[key])
    elif isinstance(expected, (list, tuple)):
        assert type(found) is type(expected) and len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            require_equal(one, other)
    else:
        assert type(found) is type(expected) and found == expected


@pytest.mark.parametrize("zip_format", [True, False])
def test_what_torch_writes_is_read(zip_format: bool) -> None:
    written = saved(content(), _use_new_zipfile_serialization=zip_format)
    found = load_tensors(written)
    require_equal(found, torch.load(io.BytesIO(written), weights_only=True))
    assert found["views"][0].untyped_storage().data_ptr() == found["views"][1].untyped_storage().data_ptr()


def test_a_header_has_no_numbers() -> None:
    written = saved(content())
    found = read_archive(io.BytesIO(written), len(written), numbers=False)
    assert found["numbers"] == content()["numbers"]
    assert all(found["dtypes"][str(dtype)].dtype == dtype for dtype in DTYPES)
    assert found["views"][2].shape == (2, 2) and found["views"][2].device.type == "meta"


@pytest.mark.parametrize("part", [torch.ones(64).numpy().tobytes(), b"a key of mine"])
def test_a_flipped_bit_in_an_archive_is_found(part: bytes) -> None:
    written = bytearray(saved({"a key of mine": torch.ones(64)}))
    written[written.index(part) + 5] ^= 4
    with pytest.raises(BadZipFile, match="CRC"):
        load_tensors(bytes(written))


class Call:
    """A value that is made by calling something."""

    def __init__(self, function: Any, *arguments: Any, state: Any = None) -> None:
        self._made = function, arguments, state

    def __reduce__(self) -> tuple[Any, ...]:
        function, arguments, state = self._made
        return (function, arguments) if state is None else (function, arguments, state)


PARTS: Any = torch._utils
PLACE, BEYOND = "larger than its storage", "out of bounds for storage"


def rebuilt(offset: Any, size: Any, stride: Any, **state: Any) -> Call:
    storage: Any = torch.ones(4).untyped_storage()
    typed = torch.storage.TypedStorage(wrap_storage=storage, dtype=torch.float32, _internal=True)
    return Call(PARTS._rebuild_tensor_v2, typed, offset, size, stride, False, OrderedDict(), state=state or None)


# What a file holds → what is said about it.
VALUES: dict[str, tuple[Callable[[], Any], str]] = {
    "bytes of any number": (lambda: Call(bytearray, 1 << 33), "it names (builtins|__builtin__) bytearray"),
    "a mapping of another": (lambda: Call(OrderedDict, [("a", 1)]), "it calls something else"),
    "a set": (lambda: {1, 2}, "it names (builtins|__builtin__) set"),
    "a tensor larger than its storage": (lambda: rebuilt(0, (1 << 40,), (0,)), PLACE),
    "a tensor beyond its storage": (lambda: rebuilt(2, (4,), (1,)), BEYOND),
    "a tensor with steps beyond it": (lambda: rebuilt(0, (2,), (1 << 40,)), BEYOND),
    "a tensor of negative sizes": (lambda: rebuilt(0, (-1, -4), (1, 1)), "it calls something else"),
    "a tensor before its storage": (lambda: rebuilt(-1, (2,), (1,)), "it calls something else"),
    "a tensor with a text as its size": (lambda: rebuilt(0, (1 << 33, "a"), (1, 1)), "it calls something else"),
    "a tensor with a tuple as its size": (lambda: rebuilt(0, (1 << 33, (0,)), (1, 1)), "it calls something else"),
    "a tensor with a fraction as its size": (lambda: rebuilt(0, (2.0,), (1,)), "it calls something else"),
    "a tensor with attributes": (lambda: rebuilt(0, (4,), (1,), a=1), "it has the instruction BUILD"),
    "a parameter of nothing": (lambda: Call(PARTS._rebuild_parameter, [1], True, {}), "it calls something else"),
    "a mapping with methods": (lambda: Hiding({"a": 1}, "items"), "it has the instruction BUILD"),
    "a key that is a tuple": (lambda: {(1, 2): 3}, "a key is no text"),
    "bytes": (lambda: b"a", "it names _codecs encode"),
}


@pytest.mark.parametrize("zip_format", [True, False])
@pytest.mark.parametrize("attack", VALUES)
def test_nothing_else_is_made(attack: str, zip_format: bool) -> None:
    make, says = VALUES[attack]
    written = saved({"a": make()}, _use_new_zipfile_serialization=zip_format)
    with pytest.raises((UnpicklingError, RuntimeError), match=says):
        load_tensors(written)


def rewritten(change: Callable[[str, bytes], list[tuple[str, bytes]]], packed: int = ZIP_STORED) -> bytes:
    """An archive of torch in which entries are others."""
    file = io.BytesIO()
    with ZipFile(io.BytesIO(saved({"a": torch.ones(64)}))) as source, ZipFile(file, "w", packed) as target:
        for entry in source.infolist():
            for name, data in change(entry.filename, source.read(entry)):
                target.writestr(name, data)
    return file.getvalue()


def pickle_of(value: Any) -> bytes:
    with ZipFile(io.BytesIO(saved(value))) as archive:
        return archive.read("archive/data.pkl")


def in_capitals(name: str, data: bytes) -> list[tuple[str, bytes]]:
    return [(name.replace("data.pkl", "DATA.PKL"), pickle_of(Call(bytearray, 9)) if "data.pkl" in name else data)]


def short(name: str, data: bytes) -> list[tuple[str, bytes]]:
    return [(name, data[:4] if name.endswith("data/0") else data)]


def many_mappings(name: str, data: bytes) -> list[tuple[str, bytes]]:
    return [(name, b"}" * (1 << 24) if name.endswith("data.pkl") else data)]


def big_endian(name: str, data: bytes) -> list[tuple[str, bytes]]:
    return [(name, b"big" if name.endswith("byteorder") else data)]


def as_it_is(name: str, data: bytes) -> list[tuple[str, bytes]]:
    return [(name, data)]


ARCHIVES: dict[str, tuple[Callable[[], bytes], str]] = {
    "a pickle in capitals": (lambda: rewritten(in_capitals), "'data.pkl'"),
    "numbers that are fewer than the pickle says": (lambda: rewritten(short), "another size than the archive says"),
    "a pickle of mappings only": (lambda: rewritten(many_mappings), "its pickle has more than 8388608 bytes"),
    "compressed parts": (lambda: rewritten(as_it_is, ZIP_DEFLATED), "compressed or overlap"),
    "parts that overlap": (lambda: overlapping(), "compressed or overlap"),
    "something before it": (lambda: b"\x80\x02" + rewritten(as_it_is), "something precedes the archive"),
    "numbers of another order": (lambda: rewritten(big_endian), "another order of bytes"),
}


def overlapping() -> bytes:
    """A directory in which an entry stands many times, so that its bytes would be read again and again."""
    written = saved({"a": torch.ones(4096)})
    first, last = written.index(b"PK\x01\x02"), written.index(b"PK\x06\x06")  # directory
    many = written[first:last] * 40
    count = many.count(b"PK\x01\x02")
    return written[:first] + many + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, count, count, len(many), first, 0)


@pytest.mark.parametrize("attack", ARCHIVES)
def test_archives_that_torch_does_not_write_are_refused(attack: str) -> None:
    make, says = ARCHIVES[attack]
    written = make()
    with pytest.raises((BadZipFile, UnpicklingError, KeyError), match=says):
        read_archive(io.BytesIO(written), len(written))


def test_only_one_archive_of_two_is_read() -> None:
    """zipfile and torch look for the directory in different places: here only one of them reads."""
    harmless, hidden = saved({"a": 1}), saved({"a": 2})
    read = hidden + harmless
    assert read_archive(io.BytesIO(read), len(read)) == {"a": 1}
