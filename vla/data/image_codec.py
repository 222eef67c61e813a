"""Individually compressed images, in one file for all rows of a field.

`<field>.pack` is their concatenation; `<field>.offsets` holds the N + 1 offsets of their beginnings and of the end, as
64-bit little-endian integers. An image is compressed by zlib or as JPEG.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from vla.parallel.limits import cores
from vla.spec import Array

JPEG, ZLIB = "jpeg", "zlib"
MODES = ("RGB", "RGBA", "L", "LA", "P")  # of Pillow, with 8 bits per channel
OFFSET = np.dtype("<u8")
LEVEL = 6  # of zlib: 9 takes four times as long to save 2 %


def pack(image: Array, codec: str, quality: int) -> bytes:
    """Compress an image; `quality` is that of JPEG, 1…95."""
    if codec == ZLIB:
        return zlib.compress(image.data, LEVEL)
    packed = io.BytesIO()
    Image.fromarray(image).save(packed, "JPEG", quality=quality)
    return packed.getvalue()


class PackedRows:
    """Array-like rows of a packed field, decoded by one thread per core.

    Args:
        folder: of the store.
        field: name of the packed field.
        codec: `JPEG` or `ZLIB`.
        shape: of the field, (N, …).
        dtype: of the field.
        damaged: row number → the error to raise if the row cannot be decoded.
    """

    def __init__(
        self,
        folder: Path,
        field: str,
        codec: str,
        shape: tuple[int, ...],
        dtype: np.dtype,
        damaged: Callable[[int], ValueError],
    ) -> None:
        self.shape, self.dtype = shape, dtype
        self._codec, self._damaged = codec, damaged
        self._offsets = np.asarray(np.memmap(folder / f"{field}.offsets", OFFSET, mode="r", shape=(len(self) + 1,)))
        self._bytes = np.asarray(np.memmap(folder / f"{field}.pack", np.uint8, mode="r"))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> Array:
        return self.take(np.arange(*rows.indices(len(self))))

    def take(self, index: Array, axis: int = 0, out: Array | None = None, mode: str = "raise") -> Array:
        """Take rows as `numpy.ndarray.take` does along axis 0; indices must be in bounds and `out` contiguous."""
        assert axis == 0
        out = np.empty((*index.shape, *self.shape[1:]), self.dtype) if out is None else out
        images, rows = out.reshape(-1, *self.shape[1:]), index.ravel()
        starts, ends = self._offsets[rows].tolist(), self._offsets[rows + 1].tolist()

        def decode(places: range) -> None:
            for place in places:
                try:
                    images[place] = self._decode(self._bytes[starts[place] : ends[place]])
                except (zlib.error, ValueError) as error:
                    raise self._damaged(int(rows[place])) from error

        pending = [_threads().submit(decode, range(first, len(rows), cores())) for first in range(cores())]
        wait(pending)  # even if one fails: no thread may use `out` or the file afterwards
        for share in pending:
            share.result()
        return out

    def stored(self, rows: slice) -> Array:
        """Return the compressed bytes (M,) of consecutive rows."""
        first, last, _ = rows.indices(len(self))
        return self._bytes[self._offsets[first] : self._offsets[last]]

    def _decode(self, packed: Array) -> Array:
        shape = self.shape[1:]
        if self._codec != ZLIB:
            return decode_image(packed.data, ("JPEG",), shape)
        size, stream = int(np.prod(shape)) * self.dtype.itemsize, zlib.decompressobj()
        rows = stream.decompress(packed.data, size + 1)  # bounded, against decompression bombs
        if len(rows) != size or not stream.eof or stream.unused_data:
            raise ValueError("the image has another size")
        return np.frombuffer(rows, self.dtype).reshape(shape)


def decode_image(packed: bytes | memoryview, formats: tuple[str, ...], shape: tuple[int, ...]) -> Array:
    """Decode an image (H, W, 3) uint8 of one of Pillow's `formats`, only if its header has this `shape`.

    Grey becomes equal colours; transparency is dropped.

    Raises:
        ValueError: the shape differs, the image is of another kind, or it is damaged.
    """
    try:
        with Image.open(io.BytesIO(packed), formats=formats) as image:
            if image.mode not in MODES or (image.height, image.width, 3) != shape:
                size = f"{shape[0]} x {shape[1]} of {', '.join(MODES)}"
                raise ValueError(f"the image is {image.height} x {image.width} pixels of {image.mode}, not {size}")
            return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    except UnidentifiedImageError as error:  # whose text has an address in memory
        raise ValueError(f"the image cannot be decoded: it is not {' or '.join(formats)}") from error
    except (OSError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        raise ValueError(f"the image cannot be decoded ({str(error)[:200]})") from error


def whole_rows(folder: Path, field: str, rows: int) -> int:
    """Return how many of the first `rows` rows of a packed field are complete: fewer if a file is truncated."""
    images, offsets = folder / f"{field}.pack", folder / f"{field}.offsets"
    if not images.exists() or not images.stat().st_size or not offsets.exists():
        return 0
    there = min(rows + 1, offsets.stat().st_size // OFFSET.itemsize)  # NumPy allocates memory for the requested count
    within = np.flatnonzero(np.fromfile(offsets, OFFSET, there)[1:] <= images.stat().st_size)
    return int(within[-1]) + 1 if len(within) else 0  # a changed offset is detected when the image is decoded


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="images")
