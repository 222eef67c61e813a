"""The choice of MuJoCo's GL backend. MuJoCo reads MUJOCO_GL on import, so worlds choose before they import it."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from vla.io.errors import UserError
from vla.parallel.processes import WORKER, without_triton

WORKING_BACKEND = "VLA_GL_WORKS"  # the backend that worked in a probe, inherited by child processes
FAILED_BACKENDS = "VLA_GL_FAILS"  # the backends that did not work
NO_BACKEND = "disabled"
PROBE = "import mujoco; mujoco.GLContext(8, 8).make_current()"
EGL_WORKS = "VLA_EGL_WORKS"  # whether the fast renderer can run, found by a probe, inherited by child processes
EGL_PROBE = "import moderngl; moderngl.create_standalone_context(backend='egl')"
EGL_DEVICE = "VLA_EGL_DEVICE"  # number of the GPU that was assigned to this process, or to the one that started it
EGL_DEVICES = "VLA_EGL_DEVICES"  # numbers of the GPUs that EGL can draw on, found by a probe, inherited likewise
DEVICES_PROBE = """
from mujoco.egl import egl_ext as egl
from OpenGL.EGL.EXT.device_query import eglQueryDeviceStringEXT

for number, device in enumerate(egl.eglQueryDevicesEXT()):
    if b"software" not in eglQueryDeviceStringEXT(device, egl.EGL_EXTENSIONS):
        display = egl.eglGetPlatformDisplayEXT(egl.EGL_PLATFORM_DEVICE_EXT, device, None)
        try:
            egl.eglInitialize(display, None, None)
        except Exception:  # a GPU that this container may not use
            continue
        print(number)
"""


def choose_backend() -> None:
    """Set MUJOCO_GL on Linux to the first that works of GLFW (with a display), EGL and OSMesa, else to "disabled".

    If the user has set a backend, only that one is probed. Triton is blocked or imported first: after Mesa's renderer,
    its LLVM would use parts of Mesa's and crash.
    """
    without_triton()
    with suppress(ImportError):
        import triton  # noqa: F401
    choose_device()
    setting = os.environ.get("MUJOCO_GL")
    is_known = setting in (NO_BACKEND, os.environ.get(WORKING_BACKEND, NO_BACKEND))
    if is_known or sys.platform != "linux":
        return
    candidates = [setting] if setting else [*(["glfw"] if os.environ.get("DISPLAY") else []), "egl", "osmesa"]
    backend = next((name for name in candidates if _output(PROBE, MUJOCO_GL=name) is not None), None)
    os.environ["MUJOCO_GL"] = backend or NO_BACKEND
    os.environ[WORKING_BACKEND if backend else FAILED_BACKENDS] = backend or " or ".join(candidates)


def choose_device() -> None:
    """Assign the worker processes to the GPUs of this machine, round-robin, for both renderers.

    A device that the user has set by MUJOCO_EGL_DEVICE_ID is kept; one that was assigned to the main process is not.
    """
    device, inherited = os.environ.get("MUJOCO_EGL_DEVICE_ID"), os.environ.get(EGL_DEVICE)
    if device in (None, inherited) and (devices := _egl_devices()):
        device = devices[int(os.environ.get(WORKER, "0")) % len(devices)]
        os.environ["MUJOCO_EGL_DEVICE_ID"] = os.environ[EGL_DEVICE] = device
    if device is not None and os.environ.get("GLCONTEXT_DEVICE_INDEX") in (None, inherited):
        os.environ["GLCONTEXT_DEVICE_INDEX"] = device  # of moderngl


def _egl_devices() -> list[str]:
    """Return the numbers of the GPUs that EGL can draw on; an empty list on a machine with a single GPU."""
    if EGL_DEVICES not in os.environ:
        has_several = len([*Path("/dev").glob("nvidia[0-9]*"), *Path("/dev/dri").glob("renderD*")]) > 1
        os.environ[EGL_DEVICES] = _output(DEVICES_PROBE, MUJOCO_GL="egl") or "" if has_several else ""
    return os.environ[EGL_DEVICES].split()


def require_backend() -> None:
    """Require that MuJoCo can render (UserError: no GL backend works on this machine)."""
    if os.environ.get("MUJOCO_GL") == NO_BACKEND:
        raise UserError(
            f"this machine cannot render with MUJOCO_GL={os.environ.get(FAILED_BACKENDS, NO_BACKEND)}: install the "
            "packages libegl1 and libgl1-mesa-dri, or libosmesa6, or set MUJOCO_GL to egl, osmesa or glfw"
        )


def has_egl() -> bool:
    """Return whether the fast renderer can draw on this machine."""
    if EGL_WORKS not in os.environ:
        os.environ[EGL_WORKS] = str(_output(EGL_PROBE) is not None)
    return os.environ[EGL_WORKS] == "True"


def _output(code: str, **settings: str) -> str | None:
    """Return what code prints in a process of its own, which a failing GL backend can abort; None if it fails."""
    environment = {**os.environ, **settings}
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    return process.stdout if process.returncode == 0 else None
