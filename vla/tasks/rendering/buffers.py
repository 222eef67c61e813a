"""Triangles on the graphics processor, uploaded again only where they have changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vla.tasks.rendering.geometry import Part


class Buffers:
    """A buffer of vertices and one of indices with the parts of all elements, one after the other."""

    def __init__(self, gl: Any) -> None:
        """Args: the context."""
        self.vertices, self.indices = gl.buffer(reserve=4), gl.buffer(reserve=4)
        self._parts: list[Part] = []

    def update(self, parts: Sequence[Part]) -> None:
        """Write the parts that have changed, or all of them where their layout has."""
        old, self._parts = self._parts, list(parts)
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        if len(old) == len(parts) and all(map(_alike, old, parts)):
            for before, part, start in zip(old, parts, starts, strict=False):
                if before is not part:
                    self.vertices.write(part.vertices, offset=int(start) * part.vertices[0].nbytes)
        elif parts:
            indices = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
            content = np.concatenate([part.vertices for part in parts]), np.concatenate(indices, dtype=np.int32)
            for buffer, values in zip((self.vertices, self.indices), content, strict=True):
                buffer.orphan(values.nbytes)
                buffer.write(values)


def _alike(one: Part, other: Part) -> bool:
    """Return whether two parts differ in nothing but what their vertices contain."""
    return one is other or (len(one.vertices) == len(other.vertices) and np.array_equal(one.triangles, other.triangles))
