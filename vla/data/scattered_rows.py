"""Rows of a file that are read in random order."""

from __future__ import annotations

from math import prod
from mmap import ACCESS_READ, MADV_RANDOM, MADV_WILLNEED, PAGESIZE, mmap
from pathlib import Path
from typing import Any

import numpy as np

from vla.spec import Array


class ScatteredRows:
    """Memory-mapped rows of which only those that are taken are read from the disk.

    When a page is missing the kernel reads ahead, on some machines by megabytes. Of a file that is larger than the free
    memory, read in random order, most of that is evicted before it is used. Here `madvise` announces the
    next rows, and the kernel reads nothing else.

    Args:
        path: of the file.
        shape: of all rows, (N, …).
        dtype: of the rows.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
        with path.open("rb") as file:
            self._file = mmap(file.fileno(), 0, access=ACCESS_READ)
        self._file.madvise(MADV_RANDOM)
        self.shape, self.dtype = shape, dtype
        self._rows = np.frombuffer(self._file, dtype, prod(shape)).reshape(shape)
        self._size = prod(shape[1:]) * dtype.itemsize  # of a row [bytes]

    def take(self, index: Array, axis: int = 0, out: Any = None, mode: Any = "raise") -> Array:
        """Take rows as `numpy.ndarray.take` does along axis 0; indices must be in bounds."""
        assert axis == 0
        for row in index.ravel().tolist():
            self._expect(row, row + 1)
        return self._rows.take(index, axis, out, mode)

    def __getitem__(self, rows: slice) -> Array:
        """Return consecutive rows."""
        start, end, _ = rows.indices(len(self._rows))
        self._expect(start, end)
        return self._rows[start:end]

    def _expect(self, start: int, end: int) -> None:
        """Let the kernel read rows from `start` to `end`, without waiting for them."""
        first = start * self._size // PAGESIZE * PAGESIZE
        if length := max(end * self._size - first, 0):
            self._file.madvise(MADV_WILLNEED, first, length)
