"""Images that are compressed one by one, in one file for all rows of a field.

`<field>.pack` holds them one after the other; `<field>.offsets` where each begins and the last one ends, N + 1 integers
of 64 bits, little-endian. An image is its bytes as zlib packs them, or a JPEG.
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
from PIL import Image

from vla.spec import Array
from vla.workers import cores

JPEG, ZLIB = "jpeg", "zlib"
OFFSET = np.dtype("<u8")
LEVEL = 6  # of zlib: 9 takes four times as long to save 2 %


def pack(image: Array, codec: str, quality: int) -> bytes:
    """An image as `codec` packs it; `quality` is that of JPEG, 1…95."""
    if codec == ZLIB:
        return zlib.compress(image.data, LEVEL)
    packed = io.BytesIO()
    Image.fromarray(image).save(packed, "JPEG", quality=quality)
    return packed.getvalue()


class PackedRows:
    """The rows of a packed field: what readers of a store ask of an array, decoded by one thread per core.

    Args:
        folder: of the store.
        field: which is packed there.
        codec: one of `CODECS`.
        shape: of the field, (N, …).
        dtype: of the field.
        changed: the error to raise where row n cannot be decoded.
    """

    def __init__(
        self,
        folder: Path,
        field: str,
        codec: str,
        shape: tuple[int, ...],
        dtype: np.dtype,
        changed: Callable[[int], ValueError],
    ) -> None:
        self.shape, self.dtype = shape, dtype
        self._codec, self._changed = codec, changed
        self._offsets = np.asarray(np.memmap(folder / f"{field}.offsets", OFFSET, mode="r", shape=(len(self) + 1,)))
        self._bytes = np.asarray(np.memmap(folder / f"{field}.pack", np.uint8, mode="r"))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> Array:
        return self.take(np.arange(*rows.indices(len(self))))

    def take(self, index: Array, axis: int = 0, out: Array | None = None, mode: str = "raise") -> Array:
        """As the method of an array, along its first axis and within its bounds; `out` must be contiguous."""
        assert axis == 0
        out = np.empty((*index.shape, *self.shape[1:]), self.dtype) if out is None else out
        images, rows = out.reshape(-1, *self.shape[1:]), index.ravel()
        starts, ends = self._offsets[rows].tolist(), self._offsets[rows + 1].tolist()

        def decode(places: range) -> None:
            for place in places:
                try:
                    images[place] = self._decode(self._bytes[starts[place] : ends[place]])
                except (zlib.error, ValueError) as error:
                    raise self._changed(int(rows[place])) from error

        under_way = [_threads().submit(decode, range(first, len(rows), cores())) for first in range(cores())]
        wait(under_way)  # even if one fails: nobody writes into `out` or reads the file any more
        for share in under_way:
            share.result()
        return out

    def stored(self, rows: slice) -> Array:
        """The bytes (M,) of consecutive rows, as they lie in the file."""
        first, last, _ = rows.indices(len(self))
        return self._bytes[self._offsets[first] : self._offsets[last]]

    def _decode(self, packed: Array) -> Array:
        shape = self.shape[1:]
        if self._codec != ZLIB:
            return decoded(packed.data, "JPEG", shape)
        size, stream = int(np.prod(shape)) * self.dtype.itemsize, zlib.decompressobj()
        rows = stream.decompress(packed.data, size + 1)  # never more, whatever the bytes may unpack to
        if len(rows) != size or not stream.eof or stream.unused_data:
            raise ValueError("the image has another size")
        return np.frombuffer(rows, self.dtype).reshape(shape)


def decoded(packed: bytes | memoryview, format: str, shape: tuple[int, ...]) -> Array:
    """An RGB image (H, W, 3) uint8 of Pillow's `format`; it is only decoded if it has that `shape`.

    Raises:
        ValueError: it has not, or is damaged.
    """
    try:
        with Image.open(io.BytesIO(packed), formats=[format]) as image:
            if image.mode != "RGB" or (image.height, image.width, 3) != shape:
                raise ValueError(f"the image is {image.height} x {image.width} pixels of {image.mode}")
            return np.asarray(image)
    except (OSError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        raise ValueError(f"the image cannot be decoded ({str(error)[:200]})") from error


def whole_rows(folder: Path, field: str, rows: int) -> int:
    """How many of `rows` rows of a packed field are there: fewer where a file was cut short."""
    images, offsets = folder / f"{field}.pack", folder / f"{field}.offsets"
    if not images.exists() or not images.stat().st_size or not offsets.exists():
        return 0
    there = min(rows + 1, offsets.stat().st_size // OFFSET.itemsize)  # NumPy reserves memory for what it is asked for
    within = np.flatnonzero(np.fromfile(offsets, OFFSET, there)[1:] <= images.stat().st_size)
    return int(within[-1]) + 1 if len(within) else 0  # what a changed offset garbles is told when it is decoded


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="images")
