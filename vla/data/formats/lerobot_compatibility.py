"""Comparison of a LeRobot dataset with the spec of a task, which collects all differences.

Shapes: N steps, D action components.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from vla.data.formats import lerobot_layout as layout
from vla.spec import Array, Spec

TOLERANCE = 1e-3  # share of the action range by which actions may exceed the bounds through rounding
IMAGES = ("video", "image")
LONGEST = 200  # characters of a dataset text in a message


def mismatches(info: layout.Info, spec: Spec) -> Iterator[str]:
    """Yield the differences between the metadata of a dataset and the spec."""
    ours, theirs = layout.features(spec, depth=False), info.features
    if info.fps != spec.control_hz:
        yield f"a rate of {info.fps:g} Hz, the task has {spec.control_hz:g} Hz"
    yield from _of_cameras(theirs, spec)
    for key in (layout.STATE, layout.ACTION):
        shape, names = ours[key]["shape"], ours[key]["names"]
        if key not in theirs:
            yield f"no {key}, it has {_shortened(theirs)}"
            continue
        known = _names(theirs[key].names)
        if list(theirs[key].shape) != shape:
            called = f" ({_shortened(known)})" if known else ""
            yield f"{key} of shape {list(theirs[key].shape)}{called}, the task has {shape} ({', '.join(names)})"
        elif known and known != names:
            yield f"{key} of {_shortened(known)}, the task has {', '.join(names)}"


def _of_cameras(theirs: dict[str, layout.Feature], spec: Spec) -> Iterator[str]:
    there = [key for key, feature in theirs.items() if feature.dtype in IMAGES]
    missing = [camera for camera in spec.cameras if layout.image_key(camera) not in there]
    if missing:
        wanted = " and ".join(layout.image_key(camera) for camera in missing)
        yield f"no images {wanted}, it has {_shortened(there) or 'none at all'}"
    for key in (layout.image_key(camera) for camera in spec.cameras if camera not in missing):
        if (size := _size(theirs[key].shape)) != spec.image_size:
            yield f"{key} of {_pixels(size)}, the task has {_pixels(spec.image_size)}"


def out_of_bounds(actions: Array, spec: Spec) -> Iterator[str]:
    """Yield the components of (N, D) actions that exceed the bounds of the spec."""
    for index, (name, low, high) in enumerate(zip(spec.action, spec.low, spec.high, strict=True)):
        least, most = float(actions[:, index].min()), float(actions[:, index].max())
        slack = TOLERANCE * (high - low)
        if least < low - slack or most > high + slack:
            unit = "" if spec.units[index] == "1" else f" {spec.units[index]}"
            yield (
                f"{name} in {layout.ACTION} from {least:.3g} to {most:.3g}, the task has {low:g} to {high:g}{unit} "
                "(other units, or absolute?)"
            )


def _names(names: Any) -> list[str] | None:
    """Return the names of components from a list or a list within a dictionary, else None."""
    found = next(iter(names.values()), None) if isinstance(names, dict) else names
    return found if isinstance(found, list) and all(isinstance(name, str) for name in found) else None


def _size(shape: Sequence[int]) -> tuple[int, ...]:
    """Return height and width, for colours first or last."""
    return tuple(shape[1:] if len(shape) == 3 and shape[0] == 3 and shape[-1] != 3 else shape[:2])


def _pixels(size: Sequence[int]) -> str:
    return f"{' x '.join(map(str, size))} pixels"


def _shortened(names: Iterable[str]) -> str:
    text = ", ".join(names)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
