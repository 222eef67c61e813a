"""Files of an episode store: the rows of one field, raw or as individually compressed images.

Raw rows follow each other in `<field>.bin`. Compressed images follow each other in `<field>.pack`, and `<field>.ends`
has a record per image: where it ends, and its CRC-32. Files may be longer than the rows that count.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from vla.data.header import Codec
from vla.data.image_codec import decode, encode, run_in_threads
from vla.io.errors import UserError
from vla.io.files import require_file
from vla.spec import Array

END = np.dtype([("end", "<u8"), ("crc", "<u4")])
MAX_OVERHEAD = 4096  # largest number of bytes by which compression may enlarge an image

DamageErrorFactory = Callable[[int], UserError]  # row → the error to raise


class ScatteredRows:
    """Array-like rows that are read one by one, in random order, and decoded by one thread per core.

    In a memory-mapped array the kernel reads ahead, on some machines by megabytes; if the file is larger than the free
    memory, most of that is evicted before it is used. Here the kernel reads the rows of a batch and nothing else.

    Args:
        field: the field of the rows.
        count: number of rows N.
        damage_error: makes the error for a row that cannot be read.
    """

    def __init__(self, field: Field, count: int, damage_error: DamageErrorFactory) -> None:
        self.shape, self.dtype, self.codec = (count, *field.shape), field.dtype, field.codec
        self._size, self._damage_error = field.size, damage_error
        self._file = field.files[0].open("rb", buffering=0)
        self._descriptor = self._file.fileno()
        self._advise("RANDOM", 0, 0)
        packed = self.codec != "raw"
        self._ends = np.asarray(np.memmap(field.files[1], END, mode="r", shape=(count,))) if packed else None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice | int) -> Array:
        return self.take(np.array(range(len(self))[rows], np.int64))

    def take(self, index: Array, axis: int = 0, out: Array | None = None, mode: str = "raise") -> Array:
        """Take rows as `numpy.ndarray.take` does along axis 0; indices must be in bounds and `out` contiguous."""
        assert axis == 0
        out = np.empty((*index.shape, *self.shape[1:]), self.dtype) if out is None else out
        images, rows = out.reshape(-1, *self.shape[1:]), index.ravel()
        places = self._places(rows)

        def unpack(number: int) -> None:
            packed = self._read_packed(int(rows[number]), *places[number])
            try:
                images[number] = decode(packed, self.codec, self.shape[1:], self.dtype)
            except UserError as error:
                raise self._damage_error(int(rows[number])) from error

        if self._ends is not None:
            run_in_threads(unpack, len(rows))
            return out
        for row, image, (start, size) in zip(rows, images, places, strict=True):
            if os.preadv(self._descriptor, [image], start) < size:
                raise self._damage_error(int(row))
        return out

    def packed_rows(self, rows: slice) -> list[bytes]:
        """Return consecutive rows in compressed form."""
        index = np.arange(*rows.indices(len(self)))
        return [self._read_packed(row, *place) for row, place in zip(index.tolist(), self._places(index), strict=True)]

    def _places(self, rows: Array) -> list[tuple[int, int]]:
        """Return offset and size [bytes] of rows in the file, and make the kernel begin to read them."""
        if self._ends is None:
            places = [(row * self._size, self._size) for row in rows.tolist()]
        else:
            starts = np.where(rows > 0, self._ends["end"][rows - 1], 0)
            ends = self._ends["end"][rows]
            sizes = ends - starts  # unsigned: negative ones are large
            if len(outliers := np.flatnonzero((sizes > self._size + MAX_OVERHEAD) | (ends > np.iinfo(np.int64).max))):
                raise self._damage_error(int(rows[outliers[0]]))
            places = list(zip(starts.tolist(), sizes.tolist(), strict=True))
        for place in places:
            self._advise("WILLNEED", *place)
        return places

    def _advise(self, use: str, start: int, size: int) -> None:
        if hasattr(os, "posix_fadvise"):  # not on macOS
            os.posix_fadvise(self._descriptor, start, size, getattr(os, f"POSIX_FADV_{use}"))

    def _read_packed(self, row: int, start: int, size: int) -> bytes:
        assert self._ends is not None, "raw rows are not compressed"
        packed = os.pread(self._descriptor, size, start)
        if zlib.crc32(packed) != self._ends["crc"][row]:
            raise self._damage_error(row)
        return packed


Rows = Array | ScatteredRows


class Field:
    """Files of a field of a store in `folder`, with rows of `shape` and `dtype`; `codec` is that of the store."""

    def __init__(self, folder: Path, name: str, shape: tuple[int, ...], dtype: np.dtype, codec: Codec) -> None:
        self.shape, self.dtype = shape, dtype
        self.codec, self._quality = codec.of_field(name), codec.quality
        self.size = int(np.prod(shape)) * dtype.itemsize  # of a decoded row [bytes]
        suffixes = ("bin",) if self.codec == "raw" else ("pack", "ends")
        self.files = [folder / f"{name}.{suffix}" for suffix in suffixes]

    def sizes(self, rows: int) -> list[int]:
        """Return the bytes of the first `rows` rows in every file."""
        if self.codec == "raw":
            return [rows * self.size]
        offset = (rows - 1) * END.itemsize
        end = int(np.fromfile(self.files[1], END, 1, offset=offset)["end"][0]) if rows else 0
        return [end, rows * END.itemsize]

    def count_complete_rows(self, rows: int) -> int:
        """Return how many of the first `rows` rows are complete: fewer if a file was truncated (UserError: one is no
        file)."""
        for path in self.files:
            require_file(path)
        sizes = [path.stat().st_size if path.exists() else 0 for path in self.files]
        rows = min(rows, sizes[-1] // (self.size if self.codec == "raw" else END.itemsize))
        if self.codec == "raw" or not rows:
            return rows
        indices = np.flatnonzero(np.fromfile(self.files[1], END, rows)["end"] <= sizes[0])
        return int(indices[-1]) + 1 if len(indices) else 0  # a changed end is detected when the image is read

    def rows(self, count: int, damage_error: DamageErrorFactory, in_random_order: bool = False) -> Rows:
        """Return the first `count` > 0 rows, which are read when they are indexed, perhaps `in_random_order`."""
        if in_random_order or self.codec != "raw":
            return ScatteredRows(self, count, damage_error)
        return np.asarray(np.memmap(self.files[0], self.dtype, mode="r", shape=(count, *self.shape)))

    def pieces(self, rows: int, values: Array, packed_rows: Sequence[bytes] | None) -> list[bytes | memoryview]:
        """Return the bytes to append to every file for `values` (N, …) after `rows` rows; `packed_rows`: compressed."""
        if self.codec == "raw":
            return [values.data.cast("B")]
        images = list(packed_rows) if packed_rows is not None else [b""] * len(values)

        def compress(number: int) -> None:
            images[number] = encode(values[number], self.codec, self._quality)

        if packed_rows is None:
            run_in_threads(compress, len(values))
        ends = np.empty(len(images), END)
        ends["end"] = self.sizes(rows)[0] + np.cumsum([len(image) for image in images])
        ends["crc"] = [zlib.crc32(image) for image in images]
        return [b"".join(images), ends.tobytes()]
