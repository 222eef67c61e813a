"""Codecs of single images: Zstandard, without loss, and JPEG.

Zstandard at its fastest level makes rendered images as small as PNG does, and unpacks them four times as fast. Of
images with the noise of a camera it saves only a fourth, JPEG nine tenths.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from vla.io.errors import UserError
from vla.io.types import Images
from vla.parallel.limits import cores
from vla.spec import Array

LEVEL = 1  # of Zstandard: 3 takes up to three times as long to save 5 %
MODES = ("RGB", "RGBA", "L", "LA", "P")  # of Pillow, with 8 bits per channel


def encode(image: Array, codec: Images, quality: int | None) -> bytes:
    """Compress an image; `quality` is that of JPEG."""
    if codec == "lossless":
        return _zstandard().compress(image, asbytes=True)
    packed = io.BytesIO()
    Image.fromarray(image).save(packed, "JPEG", quality=quality)
    return packed.getvalue()


def decode(packed: bytes, codec: Images, shape: tuple[int, ...], dtype: np.dtype) -> Array:
    """Invert `encode`; a UserError for damaged images and those of another shape, before memory is taken for them."""
    if codec == "jpeg":
        return decode_image(packed, ("JPEG",), shape)
    try:
        rows = _zstandard().decompress(packed, int(np.prod(shape)) * dtype.itemsize)
    except OSError as error:
        raise UserError(f"the image cannot be decoded ({error})") from error
    return np.frombuffer(rows, dtype).reshape(shape)


def decode_image(packed: bytes | memoryview, formats: tuple[str, ...], shape: tuple[int, ...]) -> Array:
    """Decode an image (H, W, 3) uint8 of one of Pillow's `formats`, only if its header has this `shape`.

    Grey becomes equal colours; transparency is dropped.

    Raises:
        UserError: the shape differs, the image is of another kind, or it is damaged.
    """
    try:
        with Image.open(io.BytesIO(packed), formats=formats) as image:
            if image.mode not in MODES or (image.height, image.width, 3) != shape:
                size = f"{shape[0]} x {shape[1]} of {', '.join(MODES)}"
                raise UserError(f"the image is {image.height} x {image.width} pixels of {image.mode}, not {size}")
            return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    except UnidentifiedImageError as error:  # whose text has an address in memory
        raise UserError(f"the image cannot be decoded: it is not {' or '.join(formats)}") from error
    except (OSError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        raise UserError(f"the image cannot be decoded ({str(error)[:200]})") from error


def in_threads(work: Callable[[int], None], count: int) -> None:
    """Call `work` with 0 … `count` - 1, on one thread per core; an error is raised once all threads have ended."""
    threads, pool = _threads()

    def share(first: int) -> None:
        for number in range(first, count, threads):
            work(number)

    pending = [pool.submit(share, first) for first in range(min(threads, count))]
    wait(pending)
    for each in pending:
        each.result()


@cache
def _threads() -> tuple[int, ThreadPoolExecutor]:
    return cores(), ThreadPoolExecutor(cores(), thread_name_prefix="images")


@cache
def _zstandard() -> Any:
    from pyarrow import Codec as Compression  # takes a fifth of a second

    return Compression("zstd", compression_level=LEVEL)
