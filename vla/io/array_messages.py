"""Messages with arrays, in the encoding of openpi's policy servers: msgpack with NumPy arrays as maps.

An array is a map of `__ndarray__`, `data`, `dtype` and `shape`, a NumPy scalar one of `__npgeneric__`, `data` and
`dtype`, all with keys of bytes (openpi_client/msgpack_numpy.py of github.com/Physical-Intelligence/openpi). Messages
are data from strangers: only plain numbers are decoded, nothing is executed, and sizes are bounded.
"""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np

from vla.io.errors import UserError

LONGEST_LIST = 10_000  # items of a list, or of all lists in a message
LONGEST_TEXT = 100_000  # characters of a string
LARGEST_MAP = 1000  # keys of a map, or maps in a message

DTYPES = {np.dtype(name).str: np.dtype(name) for name in ("bool", *"bBhHiIlLqQ", *"efd")}


def pack(message: Any) -> bytes:
    """Encode plain values and arrays; raise a TypeError for anything else."""
    data: Any = msgpack.packb(message, default=_encode)
    return bytes(data)


def unpack(data: bytes) -> Any:
    """Decode a message; arrays are read-only views of `data`, and those without a dimension are Python's numbers.

    Raises a UserError if it is damaged, too large, or holds something else than plain values and arrays of numbers.
    """
    budget = _Budget()
    bounds = {"max_array_len": LONGEST_LIST, "max_map_len": LARGEST_MAP, "max_str_len": LONGEST_TEXT, "max_ext_len": 0}
    try:
        return msgpack.unpackb(data, object_hook=budget.take_map, list_hook=budget.take_list, **bounds)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        reason = str(error)[:200] or type(error).__name__
        raise UserError(f"the message cannot be read as msgpack with arrays of numbers: {reason}") from error


class _Budget:
    """Hooks of the decoder, which bound the number of lists and maps: small messages could fill the memory."""

    def __init__(self) -> None:
        self._items, self._maps = LONGEST_LIST, LARGEST_MAP

    def take_list(self, values: list[Any]) -> list[Any]:
        self._items -= 1 + len(values)
        if self._items < 0:
            raise UserError(f"its lists hold more than {LONGEST_LIST} items: send arrays")
        return values

    def take_map(self, values: dict[Any, Any]) -> Any:
        self._maps -= 1
        if self._maps < 0:
            raise UserError(f"it holds more than {LARGEST_MAP} maps")
        if b"__ndarray__" in values:
            return _array(values)
        return _scalar(values) if b"__npgeneric__" in values else values


def _encode(value: Any) -> Any:
    dtype = getattr(value, "dtype", None)
    if dtype is None or dtype.str not in DTYPES:
        raise TypeError(f"cannot send {type(value).__name__} {dtype or ''}")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": dtype.str, b"shape": value.shape}
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": dtype.str}


def _array(values: dict[Any, Any]) -> np.ndarray:
    dtype, data, shape = _dtype(values), values.get(b"data"), values.get(b"shape")
    if not isinstance(shape, list) or len(shape) > 8 or not all(type(n) is int and n >= 0 for n in shape):
        raise UserError("an array has no valid shape")
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * dtype.itemsize:
        raise UserError(f"an array of shape {shape} has too many or too few bytes")
    array = np.frombuffer(data, dtype).reshape(shape)
    return array if shape else array.item()


def _scalar(values: dict[Any, Any]) -> Any:
    dtype, data = _dtype(values), values.get(b"data")
    if not isinstance(data, (bool, int, float)):
        raise UserError("a NumPy scalar is no number")
    return np.array(data, dtype).item()


def _dtype(values: dict[Any, Any]) -> np.dtype[Any]:
    name = values.get(b"dtype")
    if not isinstance(name, str) or name not in DTYPES:
        raise UserError(f"an array has the type {str(name)[:50]}, expected one of {', '.join(DTYPES)}")
    return DTYPES[name]
