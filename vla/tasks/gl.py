"""The choice of MuJoCo's GL backend, which it reads from MUJOCO_GL when imported; whether the fast renderer works."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

TRIED = "VLA_GL_WORKS"  # the backend that worked in a probe, inherited by child processes
PROBE = "import mujoco; mujoco.GLContext(8, 8).make_current()"
EGL = "VLA_EGL_WORKS"  # whether the fast renderer has what it needs, found by a probe, inherited by child processes
EGL_PROBE = "import moderngl; moderngl.create_standalone_context(backend='egl')"


def choose_backend(required: bool = True) -> None:
    """Set MUJOCO_GL unless it is set: EGL on a machine without a display, OSMesa if EGL fails.

    Must run before MuJoCo is first imported.

    Args:
        required: if False and no backend works, disable rendering instead of raising.

    Raises:
        RuntimeError: no GL backend works on this machine.
    """
    if not Path("/dev/nvidiactl").exists():
        # Mesa's software renderer and Triton each contain an LLVM, and processes that load both crash.
        # Without an NVIDIA GPU, PyTorch imports Triton but does not use it.
        sys.modules.setdefault("triton", None)  # type: ignore[arg-type]
        logging.getLogger("torch.utils.flop_counter").setLevel(logging.ERROR)  # warns without Triton
    chosen = os.environ.get("MUJOCO_GL")
    if os.environ.get("DISPLAY") or sys.platform != "linux" or (chosen and chosen == os.environ.get(TRIED)):
        return
    candidates = [chosen] if chosen else ["egl", "osmesa"]
    for backend in candidates:
        environment = {**os.environ, "MUJOCO_GL": backend}
        # A failing GL backend can abort the process, so probe it in a subprocess.
        if subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = os.environ[TRIED] = backend
            return
    if not required:
        os.environ["MUJOCO_GL"] = "disabled"
        return
    raise RuntimeError(
        f"this machine cannot render with MUJOCO_GL={' or '.join(candidates)}: install the packages libegl1 and "
        "libgl1-mesa-dri, or libosmesa6, or set MUJOCO_GL to egl, osmesa or glfw"
    )


def has_egl() -> bool:
    """Return whether the fast renderer can draw on this machine."""
    if EGL not in os.environ:
        probe = subprocess.run([sys.executable, "-c", EGL_PROBE], capture_output=True)
        os.environ[EGL] = str(probe.returncode == 0)
    return os.environ[EGL] == "True"
