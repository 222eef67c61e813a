"""Which GL implementation MuJoCo renders with; apart from the renderer, because MuJoCo reads the choice on import."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

TRIED = "VLA_GL_WORKS"  # the backend that was seen to work, for the processes that this one starts
PROBE = "import mujoco; mujoco.GLContext(8, 8).make_current()"


def choose_backend(required: bool = True) -> None:
    """Set MUJOCO_GL, unless it is set: EGL on a machine without a display, OSMesa where EGL does not work.

    Where neither works, and none is `required`, rendering is disabled.

    Must run before MuJoCo is first imported, because it reads the variable then.

    Raises:
        RuntimeError: no GL implementation works on this machine.
    """
    if not Path("/dev/nvidiactl").exists():
        # Mesa's software renderer and Triton each bring an LLVM, and processes with both were seen to crash.
        # Without an NVIDIA GPU, PyTorch imports Triton but has no use for it.
        sys.modules.setdefault("triton", None)  # type: ignore[arg-type]
        logging.getLogger("torch.utils.flop_counter").setLevel(logging.ERROR)  # would complain
    chosen = os.environ.get("MUJOCO_GL")
    if os.environ.get("DISPLAY") or sys.platform != "linux" or (chosen and chosen == os.environ.get(TRIED)):
        return
    candidates = [chosen] if chosen else ["egl", "osmesa"]
    for backend in candidates:
        environment = {**os.environ, "MUJOCO_GL": backend}
        # A failing GL can end the process, so it is tried in another one.
        if subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = os.environ[TRIED] = backend
            return
    if not required:
        os.environ["MUJOCO_GL"] = "disabled"
        return
    raise RuntimeError(
        f"nothing here can render with MUJOCO_GL={' or '.join(candidates)}: install the packages libegl1 and "
        "libgl1-mesa-dri, or libosmesa6, or set MUJOCO_GL to egl, osmesa or glfw"
    )
