"""MuJoCo's own renderer, one pass per camera."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from vla.io.parts import FULL_WINDOW
from vla.spec import Array
from vla.tasks.rendering.projections import clip_range
from vla.tasks.rendering.renderer import Views


class Reference:
    """Factory of MuJoCo's own renderer, whose settings are in the model's `visual` element."""

    def open(self, model: mujoco.MjModel, views: Views) -> ReferenceRenderer:
        """Make a renderer of `model`, with a GL context in this thread."""
        return ReferenceRenderer(model, views)


class ReferenceRenderer:
    """MuJoCo's classic renderer without reflections."""

    def __init__(self, model: mujoco.MjModel, views: Views) -> None:
        self._model, self._views = model, views
        # The off-screen buffer is allocated with the context, so its size must be set first.
        model.vis.global_.offwidth, model.vis.global_.offheight = views.width, views.height
        self._gl = mujoco.GLContext(views.width, views.height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + model.nsite + 50)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in views.geom_groups for group in range(mujoco.mjNGROUP)]
        self._option.sitegroup[:] = [group in views.site_groups for group in range(mujoco.mjNGROUP)]
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._rect = mujoco.MjrRect(0, 0, views.width, views.height)

    def update(self, textures: Collection[int] = ()) -> None:
        """Upload changed textures; MuJoCo reads everything else at each frame."""
        if textures:
            self._gl.make_current()
        for texture in sorted(textures):
            mujoco.mjr_uploadTexture(self._model, self._context, texture)

    def render(self, data: mujoco.MjData, windows: Array | None = None) -> tuple[Array, Array]:
        """Draw colours (cameras, H, W, 3) uint8 and depth (cameras, H, W) float32 [m]."""
        self._gl.make_current()
        views = self._views
        rgb = np.empty((len(views.cameras), views.height, views.width, 3), np.uint8)
        depth = np.empty(rgb.shape[:3], np.float32)
        for number, camera in enumerate(views.cameras):
            self._draw(data, camera, None if windows is None else windows[number])
            mujoco.mjr_readPixels(rgb[number], depth[number], self._rect, self._context)
        return rgb[:, ::-1], self._metres(depth[:, ::-1])  # OpenGL's lowest row is the first one

    def _draw(self, data: mujoco.MjData, camera: int, window: Sequence[float] | None) -> None:
        self._camera.fixedcamid = camera
        categories = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, categories, self._scene)
        if window is None and self._views.aspect is not None:
            window = FULL_WINDOW
        if window is not None:
            for eye in self._scene.camera:
                self._show(eye, *window)
        mujoco.mjr_render(self._rect, self._scene, self._context)

    def _show(self, eye: mujoco.MjvGLCamera, top: float, left: float, bottom: float, right: float) -> None:
        """Narrow the frustum of one eye of the scene's camera to a window."""
        top_edge, height = eye.frustum_top, eye.frustum_top - eye.frustum_bottom
        # Half of the width, despite MuJoCo's name for it; if it is 0, the aspect ratio of the pictures determines it.
        half = eye.frustum_width or (self._views.aspect or self._views.width / self._views.height) * height / 2
        eye.frustum_center += half * (left + right - 1)
        eye.frustum_width = half * (right - left)
        eye.frustum_top, eye.frustum_bottom = top_edge - top * height, top_edge - bottom * height

    def _metres(self, reading: Array) -> Array:
        """Convert a reverse-z buffer, 1 at the near plane and 0 at the far one, to depth [m]."""
        near, far = clip_range(self._model)
        return near * far / (near + reading * (far - near)) * (reading > 0)

    def close(self) -> None:
        """Free the GL context; otherwise a traceback is printed when Python exits."""
        self._gl.make_current()  # GL would free objects of the same numbers in another renderer's context
        self._context.free()
        self._gl.free()
