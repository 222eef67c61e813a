"""Messages with arrays, in the encoding of openpi's policy servers: msgpack with NumPy arrays as maps.

An array is a map of `__ndarray__`, `data`, `dtype` and `shape`, a NumPy scalar one of `__npgeneric__`, `data` and
`dtype`, all with keys of bytes (openpi_client/msgpack_numpy.py of github.com/Physical-Intelligence/openpi). Messages
are data from strangers: only plain numbers are decoded, and nothing is executed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.io.errors import UserError

try:
    import msgpack
    import websockets  # noqa: F401 who encodes messages sends them
except ModuleNotFoundError as error:
    hint = f"install this package with its extra server, as in pip install -e '.[server]' ({error})"
    raise ModuleNotFoundError(hint, name=error.name) from error

DTYPES = {np.dtype(name).str: np.dtype(name) for name in ("bool", *"bBhHiIlLqQ", *"efd")}


def pack(message: Any) -> bytes:
    """Encode plain values and arrays.

    Raises:
        TypeError: a value is neither.
    """
    data: Any = msgpack.packb(message, default=_encode)
    return bytes(data)


def unpack(data: bytes) -> Any:
    """Decode a message; arrays are read-only views of `data`, and those without a dimension are Python's numbers.

    Raises:
        UserError: it is damaged, or holds something else than plain values and arrays of numbers.
    """
    try:
        return msgpack.unpackb(data, object_hook=_decode, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        what = str(error)[:200] or type(error).__name__
        raise UserError(f"this is no message in msgpack with arrays of numbers: {what}") from error


def _encode(value: Any) -> Any:
    kind = getattr(value, "dtype", None)
    if kind is None or kind.str not in DTYPES:
        raise TypeError(f"cannot send {type(value).__name__} {kind or ''}")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": kind.str, b"shape": value.shape}
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": kind.str}


def _decode(values: dict[Any, Any]) -> Any:
    """Return the array or the number that a map stands for, or the map itself."""
    if not values.keys() & {b"__ndarray__", b"__npgeneric__"}:
        return values
    name = values.get(b"dtype")
    if not isinstance(name, str) or name not in DTYPES:
        raise UserError(f"an array has the type {str(name)[:50]}, expected one of {', '.join(DTYPES)}")
    if b"__npgeneric__" in values:
        return np.array(values.get(b"data"), DTYPES[name]).item()
    array = np.frombuffer(values.get(b"data", b""), DTYPES[name]).reshape(values.get(b"shape"))
    return array if array.ndim else array.item()
