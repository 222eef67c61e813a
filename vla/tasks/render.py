"""Colour and depth of every camera from one render pass each."""

from __future__ import annotations

import mujoco
import numpy as np

from vla.spec import Array

MILLIMETRES = 1000.0


class Renderer:
    """Renders a compiled model off screen; owns a GL context that belongs to the thread which made it."""

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        """Args: the model; image size [px]."""
        self._model, self._height, self._width = model, height, width
        # The off-screen buffer is allocated with the context, so it must be asked for before.
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl = mujoco.GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 50)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [0, 0, 1, 0, 0, 0]
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._rgb = np.empty((height, width, 3), np.uint8)
        self._depth = np.empty((height, width), np.float32)

    def take_over(self, textures: set[int]) -> None:
        """Bring changed textures of the model, by number, to where images are made; empties the set."""
        if textures:
            self._gl.make_current()
        while textures:
            mujoco.mjr_uploadTexture(self._model, self._context, textures.pop())

    def render(self, data: mujoco.MjData, camera: int) -> tuple[Array, Array]:
        """(H, W, 3) uint8 colours and (H, W) uint16 depth along the optical axis [mm] of camera number `camera`."""
        self._gl.make_current()
        self._camera.fixedcamid = camera
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._depth, self._rect, self._context)
        return np.flipud(self._rgb).copy(), np.flipud(self._millimetres(self._depth))

    def _millimetres(self, reading: Array) -> Array:
        """Depth of a reverse-z buffer: 1 at the near plane, 0 at the far one (inverse of the perspective map)."""
        near = float(self._model.vis.map.znear * self._model.stat.extent) * MILLIMETRES
        far = float(self._model.vis.map.zfar * self._model.stat.extent) * MILLIMETRES
        depth = near * far / (near + reading * (far - near))
        depth *= reading > 0
        return np.rint(depth, out=depth).astype(np.uint16)

    def close(self) -> None:
        """Free the GL context; without it a traceback is printed when Python exits."""
        self._context.free()
        self._gl.free()
