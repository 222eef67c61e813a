"""Videos of a LeRobot dataset, AV1, encoded and decoded with PyAV.

Shapes: N frames, H by W pixels.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path

import av
from av.video.frame import PictureType

from vla.io.errors import UserError
from vla.io.files import require_file
from vla.spec import Array

CODEC = "libsvtav1"
PIXELS = "yuv420p"  # the only layout that the encoder supports
# How long before a frame decoding starts [s]: in some videos the frames before a key frame need the one before that.
LEADS = 0.0, 1.0, 10.0
VIDEO_REMEDY = "copy the video again from where it is whole, or encode it again"


def encode(path: Path, clips: Iterable[Array], size: tuple[int, int], fps: Fraction, crf: int) -> None:
    """Write clips, each (N, H, W, 3) uint8 with images of `size` (H, W), in sequence as one MP4.

    Every clip begins with a key frame, and at least every second frame is one, for fast random access. The same clips
    give the same bytes. `crf` is the quality, from 0 (best) to 63.
    """
    os.environ.setdefault("SVT_LOG", "1")  # errors only: the encoder prints its settings for every file otherwise
    options = {"g": "2", "crf": str(crf), "preset": "12", "svtav1-params": "lp=1"}  # files run in parallel
    with av.open(path, "w", format="mp4", options={"fflags": "+bitexact"}) as file:
        stream = file.add_stream(CODEC, rate=fps, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.pix_fmt = PIXELS
        stream.height, stream.width = size
        _open_codec(stream)
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


def _open_codec(stream: av.VideoStream) -> None:
    """Open the encoder of a stream, and undo the real-time priority that SVT-AV1 takes.

    Run by root, it moves its threads and the calling one to SCHED_FIFO with priority 99, which starves every other
    process of the machine, also after the video is closed.
    """
    if sys.platform != "linux":
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    stream.codec_context.open()
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # it has ended
            if os.sched_getscheduler(int(thread)) == os.SCHED_FIFO:
                os.sched_setscheduler(int(thread), policy, parameters)


def decode(
    path: Path, start: float, count: int, fps: Fraction, size: tuple[int, int], every: int = 1
) -> Iterator[Array]:
    """Yield every `every`-th of `count` frames of a video from `start` [s] on, (H, W, 3) uint8 of `size` (H, W)
    (UserError: the video cannot be read, has images of another size, or lacks a frame)."""
    next_number = 0
    with _open_video(path) as (file, stream):
        _require_size(path, stream, size)  # before anything is decoded
        for lead in LEADS:
            file.seek(round(max(start - lead, 0.0) / (stream.time_base or 1)), stream=stream)  # the key frame before it
            for frame in file.decode(stream):
                _require_size(path, frame, size)
                number = -1 if frame.time is None else round((frame.time - start) * float(fps))
                if number == next_number < count:
                    yield frame.to_ndarray(format="rgb24")
                    next_number += every
                if next_number >= count or number > next_number:
                    break
            if next_number >= count:
                break
    if next_number < count:
        raise UserError(f"{path} lacks the frame at {start + next_number / float(fps):.3f} s: {VIDEO_REMEDY}")


def require_video(path: Path, size: tuple[int, int], fps: Fraction, count: int) -> None:
    """Raise a UserError unless the header of a video states `size` (H, W), at least `count` images, and the rate.

    The rate may differ as long as the first `count` images are the right ones.
    """
    with _open_video(path) as (_, stream):
        _require_size(path, stream, size)
        rates, frames = [rate for rate in (stream.average_rate, stream.base_rate) if rate], stream.frames
    rate = min(rates, key=lambda rate: abs(rate - fps), default=fps)  # the average may count the last image less
    if abs(rate - fps) * count > 0.5 * fps:
        raise UserError(
            f"{path} has {float(rate):.5g} images per second, the dataset {float(fps):.5g}: encode the video again at "
            "that rate, or write its own as fps into meta/info.json"
        )
    if 0 < frames < count:  # 0: unknown
        raise UserError(f"{path} has {frames} images of the {count} that the dataset needs: {VIDEO_REMEDY}")


@contextmanager
def _open_video(path: Path) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """Open a video and its first stream; errors of reading it within the context become a UserError."""
    require_file(path)
    try:
        with av.open(path, format="mp4") as file:  # other formats may be playlists of files anywhere
            yield file, file.streams.video[0]
    except (av.error.FFmpegError, OSError, IndexError) as error:
        raise UserError(f"{path} cannot be read as a video ({error}): {VIDEO_REMEDY}") from error


def _require_size(path: Path, images: av.VideoStream | av.VideoFrame, size: tuple[int, int]) -> None:
    if (images.height, images.width) != size:
        raise UserError(f"{path} is {images.height} x {images.width} pixels, meta/info.json has {size[0]} x {size[1]}")
