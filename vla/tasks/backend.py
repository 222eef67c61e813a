"""Which GL implementation MuJoCo renders with; apart from the renderer, because MuJoCo reads the choice on import."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from importlib import import_module


def choose_backend() -> None:
    """Set MUJOCO_GL, unless it is set: EGL on a machine without a display, OSMesa where EGL does not work.

    Must run before MuJoCo is first imported, because it reads the variable then.
    """
    # Mesa's software renderer and Triton, which PyTorch may import at any later time, each bring an LLVM of their own;
    # the process crashes if Triton's comes second.
    with suppress(ImportError):
        import_module("triton._C.libtriton")
    if "MUJOCO_GL" in os.environ or os.environ.get("DISPLAY") or sys.platform != "linux":
        return
    # A failing EGL can end the process, so it is tried in another one.
    probe = "import mujoco; mujoco.GLContext(8, 8).make_current()"
    for backend in ("egl", "osmesa"):
        tried = subprocess.run(
            [sys.executable, "-c", probe], env={**os.environ, "MUJOCO_GL": backend}, capture_output=True
        )
        if tried.returncode == 0:
            os.environ["MUJOCO_GL"] = backend
            return
    os.environ["MUJOCO_GL"] = "egl"
