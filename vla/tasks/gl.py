"""The choice of MuJoCo's GL backend. MuJoCo reads MUJOCO_GL on import, so worlds choose before they import it."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress

from vla.parallel.processes import without_triton

WORKING_BACKEND = "VLA_GL_WORKS"  # the backend that worked in a probe, inherited by child processes
FAILED_BACKENDS = "VLA_GL_FAILS"  # those that did not
NO_BACKEND = "disabled"
PROBE = "import mujoco; mujoco.GLContext(8, 8).make_current()"
EGL_WORKS = "VLA_EGL_WORKS"  # whether the fast renderer can run, found by a probe, inherited by child processes
EGL_PROBE = "import moderngl; moderngl.create_standalone_context(backend='egl')"


def choose_backend() -> None:
    """Set MUJOCO_GL on a machine without a display: EGL_WORKS, OSMesa if EGL_WORKS fails, "disabled" if both fail.

    A backend that the user has set is only probed. Triton, which conflicts with Mesa, is blocked too.
    """
    without_triton()
    with suppress(ImportError):  # the system's library: after Mesa it would be Mesa's, and bags would have other bytes
        import backports.zstd  # noqa: F401
    chosen = os.environ.get("MUJOCO_GL")
    if (
        os.environ.get("DISPLAY")
        or sys.platform != "linux"
        or chosen in (NO_BACKEND, os.environ.get(WORKING_BACKEND, NO_BACKEND))
    ):
        return
    candidates = [chosen] if chosen else ["egl", "osmesa"]
    works = next((name for name in candidates if _runs(PROBE, MUJOCO_GL=name)), None)
    os.environ["MUJOCO_GL"] = works or NO_BACKEND
    os.environ[WORKING_BACKEND if works else FAILED_BACKENDS] = works or " or ".join(candidates)


def require_backend() -> None:
    """Require that MuJoCo can render.

    Raises:
        RuntimeError: no GL backend works on this machine.
    """
    if os.environ.get("MUJOCO_GL") == NO_BACKEND:
        raise RuntimeError(
            f"this machine cannot render with MUJOCO_GL={os.environ.get(FAILED_BACKENDS, NO_BACKEND)}: install the "
            "packages libegl1 and libgl1-mesa-dri, or libosmesa6, or set MUJOCO_GL to egl, osmesa or glfw"
        )


def has_egl() -> bool:
    """Return whether the fast renderer can draw on this machine."""
    if EGL_WORKS not in os.environ:
        os.environ[EGL_WORKS] = str(_runs(EGL_PROBE))
    return os.environ[EGL_WORKS] == "True"


def _runs(code: str, **settings: str) -> bool:
    # In a process of its own, which a failing GL backend can abort.
    environment = {**os.environ, **settings}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0
