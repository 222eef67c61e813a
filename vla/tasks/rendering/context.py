"""The GL context of this process, which all fast renderers share.

Drivers compile shaders and the filters of textures anew in every context, which takes most of the time that it takes to
open a renderer.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

import moderngl

BACKEND: Any = {"backend": "egl"}  # moderngl's type annotations are too narrow


class Context:
    """A GL context that one renderer uses at a time, from any thread.

    Attributes:
        gl: the context of moderngl.
    """

    def __init__(self) -> None:
        """Raises an exception of any kind on a machine without EGL."""
        self.gl: Any = moderngl.create_standalone_context(**BACKEND)
        self.gl.gc_mode = "context_gc"  # objects must not be freed while another context is current
        self.gl.depth_func = "<="
        self._lock, self._user = Lock(), 0

    @contextmanager
    def used_by(self, renderer: object) -> Iterator[bool]:
        """Make the context current; tell whether another renderer may have changed its bindings meanwhile."""
        with self._lock, self.gl:
            changed, self._user = self._user != id(renderer), id(renderer)
            yield changed

    def clean(self) -> None:
        """Free the objects that nobody refers to any more."""
        with self._lock, self.gl:
            self.gl.gc()
            self._user = 0


def shared_context() -> Context:
    """Return the context of this process, made with the first call."""
    return _context(os.getpid())  # a fork cannot use that of its parent


@cache
def _context(process: int) -> Context:
    return Context()
