"""Camera images as AV1 video and back, by PyAV."""

from __future__ import annotations

import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.frame import PictureType

from vla.spec import Array

CODEC = "libsvtav1"
PIXELS = "yuv420p"  # the only layout that the encoder takes


def encode(path: Path, clips: Iterable[Array], size: tuple[int, int], fps: Fraction, crf: int) -> None:
    """Write clips, each (N, H, W, 3) uint8 with images of `size` (H, W), one after the other as an MP4.

    Every clip begins with a key frame, and at least every second frame is one: single frames can be read fast. The same
    clips give the same bytes. `crf` is the quality, from 0, the best, to 63.
    """
    os.environ.setdefault("SVT_LOG", "1")  # errors only: the encoder prints its settings for every file otherwise
    options = {"g": "2", "crf": str(crf), "preset": "12", "svtav1-params": "lp=1"}  # one thread: files share the cores
    with av.open(path, "w", format="mp4", options={"fflags": "+bitexact"}) as file:
        stream = file.add_stream(CODEC, rate=fps, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.pix_fmt = PIXELS
        stream.height, stream.width = size
        number = 0
        for clip in clips:
            for place, image in enumerate(clip):
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                frame.pts, frame.time_base = number, 1 / fps
                if place == 0:
                    frame.pict_type = PictureType.I
                file.mux(stream.encode(frame))
                number += 1
        file.mux(stream.encode(None))


def decode(path: Path, start: float, count: int, fps: Fraction, size: tuple[int, int]) -> Array:
    """The `count` frames of a video from `start` [s] on, (count, H, W, 3) uint8 with images of `size` (H, W).

    Raises:
        ValueError: the video cannot be read, has images of another size, or does not hold them.
    """
    images: dict[int, Array] = {}
    try:
        with av.open(path) as file:
            stream = file.streams.video[0]
            _require_size(path, stream, size)  # before anything is decoded
            file.seek(round(start / (stream.time_base or 1)), stream=stream)  # the key frame before it
            for frame in file.decode(stream):
                _require_size(path, frame, size)
                number = -1 if frame.time is None else round((frame.time - start) * float(fps))
                if number >= count:
                    break
                if number >= 0:
                    images[number] = frame.to_ndarray(format="rgb24")
    except (av.error.FFmpegError, OSError, IndexError) as error:
        raise ValueError(f"{path} cannot be read as a video: {error}") from error
    missing = [number for number in range(count) if number not in images]
    if missing:
        raise ValueError(f"{path} lacks the frame at {start + missing[0] / float(fps):.3f} s")
    return np.stack([images[number] for number in range(count)])


def _require_size(path: Path, images: av.VideoStream | av.VideoFrame, size: tuple[int, int]) -> None:
    if (images.height, images.width) != size:
        raise ValueError(f"{path} has images of {images.height} x {images.width} pixels, not {size[0]} x {size[1]}")
