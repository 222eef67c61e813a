"""Projections of the world into pictures and into shadow maps, and what cameras see."""

from __future__ import annotations

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.rendering.renderer import Views

UPSIDE_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])  # the first row of the framebuffer becomes the top of the picture
DIRECTIONAL = 1  # of mjtLightType, which is missing in MuJoCo 3.3.0, where `reference` must work, too
WIDEST = 160.0  # field of view of a spot light's shadow map [degrees]


def clip_range(model: mujoco.MjModel) -> tuple[float, float]:
    """Return the distances of the near and the far clipping plane [m]."""
    extent = float(model.stat.extent)
    return float(model.vis.map.znear) * extent, float(model.vis.map.zfar) * extent


def frustum(left: float, right: float, bottom: float, top: float, near: float, far: float) -> Array:
    """Return the perspective projection matrix (4, 4) of a frustum, given its rectangle at the near plane [m]."""
    width, height, depth = right - left, top - bottom, far - near
    return np.array(
        [
            [2 * near / width, 0, (right + left) / width, 0],
            [0, 2 * near / height, (top + bottom) / height, 0],
            [0, 0, -(far + near) / depth, -2 * far * near / depth],
            [0, 0, -1, 0],
        ]
    )


def box(half_width: float, half_height: float, near: float, far: float) -> Array:
    """Return the orthographic projection matrix (4, 4) of a box around the optical axis; lengths in [m]."""
    depth = far - near
    return np.array(
        [[1 / half_width, 0, 0, 0], [0, 1 / half_height, 0, 0], [0, 0, -2 / depth, -(far + near) / depth], [0, 0, 0, 1]]
    )


def inverse_pose(position: Array, axes: Array) -> Array:
    """Return transformations (…, 4, 4) into frames at `position` (…, 3) with `axes` (…, 3, 3), one per row."""
    view = np.zeros((*position.shape[:-1], 4, 4))
    view[..., :3, :3], view[..., 3, 3] = axes, 1
    view[..., :3, 3] = -(axes @ position[..., None])[..., 0]
    return view


def shadow_projection(model: mujoco.MjModel, data: mujoco.MjData, light: int) -> Array:
    """Return the projection (4, 4) of the world into a light's shadow map, -1…1."""
    near, far = clip_range(model)
    if model.light_type[light] == DIRECTIONAL:
        reach = float(model.vis.map.shadowclip * model.stat.extent)
        projection = box(reach, reach, near, far)
    else:
        angle = min(2 * float(model.light_cutoff[light]) * float(model.vis.map.shadowscale), WIDEST)
        half = near * np.tan(np.radians(angle / 2))
        projection = frustum(-half, half, -half, half, near, far)
    forward = data.light_xdir[light]
    up = np.cross(forward, [-1.0, 0.0, 0.0])
    if up @ up <= 0.01:
        up = np.cross(forward, [0.0, 1.0, 0.0])
    up /= np.linalg.norm(up)
    axes = np.stack([np.cross(forward, up), up, -forward])
    return projection @ inverse_pose(data.light_xpos[light], axes)


class ModelCameras:
    """The cameras of a model that pictures are drawn for, in the current state."""

    def __init__(self, model: mujoco.MjModel, views: Views) -> None:
        self._model, self._views, self.ids = model, views, np.array(views.cameras)

    def update(self) -> None:
        """Read the projections of the cameras from the model."""
        self._lenses = np.stack([self._lens(camera) for camera in self.ids])

    def place(self, data: mujoco.MjData, windows: Array | None) -> Array:
        """Read the poses of the cameras from a state; return the projections (cameras, 4, 4) of the world.

        For `windows` see `Renderer.render`.
        """
        self.eyes, self.axes = data.cam_xpos[self.ids], data.cam_xmat[self.ids].reshape(-1, 3, 3)
        lenses = self._lenses if windows is None else _enlargements(windows) @ self._lenses
        projections = UPSIDE_DOWN @ lenses @ inverse_pose(self.eyes, self.axes.swapaxes(1, 2))
        x, y, z, w = projections.swapaxes(0, 1)
        sides = np.stack([w + x, w - x, w + y, w - y, w + z], axis=1)
        self._sides = sides / np.linalg.norm(sides[:, :, :3], axis=2, keepdims=True)  # of the frustums, looking inwards
        return projections

    def may_see(self, centres: Array, radii: Array) -> Array:
        """Return which spheres at `centres` (N, 3), of `radii` (N,) [m], reach into a picture: (cameras, N) bool."""
        distances = self._sides[:, :, :3] @ centres.T + self._sides[:, :, 3:]
        return (distances > -radii).all(axis=1)

    def sees_from_behind(self, number: int, plane: Array) -> bool:
        """Return whether a camera sees a plane of pose (3, 4) from behind."""
        return bool((self.eyes[number] - plane[:, 3]) @ plane[:, 2] < 0)

    def _lens(self, camera: int) -> Array:
        """Return a camera's projection (4, 4)."""
        model, (near, far) = self._model, clip_range(self._model)
        aspect, fovy = self._views.aspect or self._views.width / self._views.height, float(model.cam_fovy[camera])
        if model.cam_projection[camera] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
            return box(aspect * fovy / 2, fovy / 2, near, far)
        if model.cam_sensorsize[camera, 1]:
            focal, centre = model.cam_intrinsic[camera, :2], model.cam_intrinsic[camera, 2:]
            half = model.cam_sensorsize[camera] / 2
            low, high = near / focal * (half - centre), near / focal * (half + centre)
            return frustum(-low[0], high[0], -high[1], low[1], near, far)
        half = near * np.tan(np.radians(fovy / 2))
        return frustum(-aspect * half, aspect * half, -half, half, near, far)


def _enlargements(windows: Array) -> Array:
    """Return transforms of clip space (cameras, 4, 4) after which windows (cameras, 4) fill the pictures."""
    top, left, bottom, right = windows.T
    transforms = np.tile(np.eye(4), (len(windows), 1, 1))
    transforms[:, 0, 0], transforms[:, 0, 3] = 1 / (right - left), (1 - left - right) / (right - left)
    transforms[:, 1, 1], transforms[:, 1, 3] = 1 / (bottom - top), (top + bottom - 1) / (bottom - top)
    return transforms
