"""The GL context of this process, which all fast renderers share.

Drivers compile shaders and texture filters anew in every context, which takes most of the time of opening a renderer.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

import moderngl

BACKEND: Any = {"backend": "egl"}  # moderngl's type annotations are too narrow
# Constants of OpenGL.
RENDERBUFFER, DEPTH_COMPONENT32F = 0x8D41, 0x8CAC
READ_FRAMEBUFFER, COLOR_ATTACHMENT0, COLOR_BUFFER_BIT, LINEAR = 0x8CA8, 0x8CE0, 0x4000, 0x2601


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
        self._lock = Lock()

    @contextmanager
    def make_current(self) -> Iterator[None]:
        """Make the context current; other renderers may have changed its bindings."""
        with self._lock, self.gl:
            yield

    def depth_renderbuffer(self, size: tuple[int, int]) -> Any:
        """Make a float32 depth buffer (width, height) in the current context, which is read without conversion.

        moderngl makes integer buffers only, so the storage is replaced.
        """
        buffer, integer = self.gl.depth_renderbuffer(size), ctypes.c_uint
        _function("glBindRenderbuffer", integer, integer)(RENDERBUFFER, buffer.glo)
        storage = _function("glRenderbufferStorage", integer, integer, ctypes.c_int, ctypes.c_int)
        storage(RENDERBUFFER, DEPTH_COMPONENT32F, *size)
        return buffer

    def halve(self, source: Any, target: Any) -> None:
        """Average every 2 by 2 pixels of a framebuffer into one of another, which has half as many rows and columns."""
        integer = ctypes.c_uint
        target.use()
        _function("glBindFramebuffer", integer, integer)(READ_FRAMEBUFFER, source.glo)
        _function("glReadBuffer", integer)(COLOR_ATTACHMENT0)  # reading depth deselected it
        blit = _function("glBlitFramebuffer", *[ctypes.c_int] * 8, integer, integer)
        blit(0, 0, *source.size, 0, 0, *target.size, COLOR_BUFFER_BIT, LINEAR)

    def clean(self) -> None:
        """Free the objects that nobody refers to any more."""
        with self.make_current():
            self.gl.gc()


@cache
def _function(name: str, *types: Any) -> Callable[..., None]:
    """Return a function of OpenGL that moderngl does not offer."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    return ctypes.CFUNCTYPE(None, *types)(egl.eglGetProcAddress(name.encode()))


def shared_context() -> Context:
    """Return the context of this process, made with the first call."""
    return _context(os.getpid())  # a fork cannot use that of its parent


@cache
def _context(process: int) -> Context:
    return Context()
