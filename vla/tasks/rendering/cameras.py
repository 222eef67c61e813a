"""Cameras of a model: their projections, and what they see."""

from __future__ import annotations

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.rendering import lights
from vla.tasks.rendering.renderer import View

UPSIDE_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])  # the first row of the framebuffer becomes the top of the picture


class Cameras:
    """The cameras of a view in the present state."""

    def __init__(self, model: mujoco.MjModel, view: View) -> None:
        """Args: the model; what to draw of it."""
        self._model, self._view, self.ids = model, view, np.array(view.cameras)
        self._near, self._far = lights.clip_range(model)

    def update(self) -> None:
        """Take over the model's present lenses."""
        self._whole = np.stack([self._lens(camera) for camera in self.ids])
        self._show(None)

    def _show(self, windows: Array | None) -> None:
        """Set the crop of each camera's field of view, (cameras, 4), see `Renderer.render`."""
        lenses = self._whole if windows is None else _enlarging(windows) @ self._whole
        self._lenses, self._windows = UPSIDE_DOWN @ lenses, windows
        across, up, deep, ahead = self._lenses.swapaxes(0, 1)
        sides = np.stack([ahead + across, ahead - across, ahead + up, ahead - up, ahead + deep], axis=1)
        self._sides = sides / np.linalg.norm(sides[:, :, :3], axis=2, keepdims=True)  # of the frustums, looking inwards

    def place(self, data: mujoco.MjData, windows: Array | None) -> Array:
        """Move the cameras to where they are in a state; return projections of the world (cameras, 4, 4)."""
        if windows is not None or self._windows is not None:
            self._show(windows)
        self.eyes, self.axes = data.cam_xpos[self.ids], data.cam_xmat[self.ids].reshape(-1, 3, 3)
        views = lights.inverse_pose(self.eyes, self.axes.swapaxes(1, 2))
        self._sides_there = self._sides @ views
        return self._lenses @ views

    def may_see(self, centres: Array, radii: Array) -> Array:
        """Return which spheres at `centres` (N, 3), of `radii` (N,) [m], reach into a picture: (cameras, N) bool."""
        distances = self._sides_there[:, :, :3] @ centres.T + self._sides_there[:, :, 3:]
        return (distances > -radii).all(axis=1)

    def behind(self, number: int, plane: Array) -> bool:
        """Return whether a camera sees a plane of pose (3, 4) from behind."""
        return bool((self.eyes[number] - plane[:, 3]) @ plane[:, 2] < 0)

    def _lens(self, camera: int) -> Array:
        """Return a camera's projection (4, 4)."""
        model, near, far = self._model, self._near, self._far
        aspect, fovy = self._view.aspect or self._view.width / self._view.height, float(model.cam_fovy[camera])
        if model.cam_projection[camera] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
            return lights.box(aspect * fovy / 2, fovy / 2, near, far)
        if model.cam_sensorsize[camera, 1]:
            focal, centre = model.cam_intrinsic[camera, :2], model.cam_intrinsic[camera, 2:]
            half = model.cam_sensorsize[camera] / 2
            low, high = near / focal * (half - centre), near / focal * (half + centre)
            return lights.frustum(-low[0], high[0], -high[1], low[1], near, far)
        half = near * np.tan(np.radians(fovy / 2))
        return lights.frustum(-aspect * half, aspect * half, -half, half, near, far)


def _enlarging(windows: Array) -> Array:
    """Return transforms of clip space (cameras, 4, 4) after which windows (cameras, 4) fill the pictures."""
    top, left, bottom, right = windows.T
    transforms = np.tile(np.eye(4), (len(windows), 1, 1))
    transforms[:, 0, 0], transforms[:, 0, 3] = 1 / (right - left), (1 - left - right) / (right - left)
    transforms[:, 1, 1], transforms[:, 1, 3] = 1 / (bottom - top), (top + bottom - 1) / (bottom - top)
    return transforms
