"""Lights of a model as MuJoCo's fixed-function lighting has them, and the projections of their shadow maps."""

from __future__ import annotations

import mujoco
import numpy as np

from vla.spec import Array

ROWS = 6  # of a light: ambient, diffuse, specular, position, direction, attenuation
SPOT, DIRECTIONAL = 0, 1  # mjtLightType, a name that MuJoCo 3.3.0 lacks, with which `reference` works
GLOBAL = 0.3  # ambient light of a model without lights
WIDEST = 160.0  # field of view of a spot light's shadow map [degrees]


def drawn(model: mujoco.MjModel) -> Array:
    """Return the ids of lights of types that MuJoCo's classic renderer draws, active or not."""
    return np.flatnonzero(np.isin(model.light_type, (DIRECTIONAL, SPOT)))


def rows(model: mujoco.MjModel) -> Array:
    """Return (1 + lights, ROWS, 4) float32: the headlight, then the drawn lights, not yet in place."""
    lights = drawn(model)
    table = np.zeros((1 + len(lights), ROWS, 4), np.float32)
    head, active = model.vis.headlight, model.light_active[lights, None].astype(bool)
    if head.active:
        table[0, :3, :3] = head.ambient, head.diffuse, head.specular
    elif not active.any():
        table[0, 0, :3] = GLOBAL
    table[0, 5, 0] = 1
    for row, name in enumerate(("ambient", "diffuse", "specular")):
        table[1:, row, :3] = np.where(active, getattr(model, f"light_{name}")[lights], 0)
    spot = model.light_type[lights] == SPOT
    table[1:, 3, 3], table[1:, 4, 3] = spot, np.cos(np.radians(model.light_cutoff[lights]))
    table[1:, 5, :3] = np.where(spot[:, None], model.light_attenuation[lights], (1, 0, 0))
    table[1:, 5, 3] = model.light_exponent[lights]
    return table


def frustum(left: float, right: float, bottom: float, top: float, near: float, far: float) -> Array:
    """Return the perspective projection matrix (4, 4) of a frustum, given its rectangle at the near plane [m]."""
    across, up, deep = right - left, top - bottom, far - near
    return np.array(
        [
            [2 * near / across, 0, (right + left) / across, 0],
            [0, 2 * near / up, (top + bottom) / up, 0],
            [0, 0, -(far + near) / deep, -2 * far * near / deep],
            [0, 0, -1, 0],
        ]
    )


def box(half_width: float, half_height: float, near: float, far: float) -> Array:
    """Return the orthographic projection matrix (4, 4) of a box around the optical axis; lengths in [m]."""
    deep = far - near
    return np.array(
        [[1 / half_width, 0, 0, 0], [0, 1 / half_height, 0, 0], [0, 0, -2 / deep, -(far + near) / deep], [0, 0, 0, 1]]
    )


def inverse_pose(position: Array, axes: Array) -> Array:
    """Return transformations (…, 4, 4) into frames at `position` (…, 3) with `axes` (…, 3, 3), one per row."""
    view = np.zeros((*position.shape[:-1], 4, 4))
    view[..., :3, :3], view[..., 3, 3] = axes, 1
    view[..., :3, 3] = -(axes @ position[..., None])[..., 0]
    return view


def clip_range(model: mujoco.MjModel) -> tuple[float, float]:
    """Return the distances of the near and the far clipping plane [m]."""
    extent = float(model.stat.extent)
    return float(model.vis.map.znear) * extent, float(model.vis.map.zfar) * extent


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
    up = _cross(forward, np.array([-1.0, 0.0, 0.0]))
    if up @ up <= 0.01:
        up = _cross(forward, np.array([0.0, 1.0, 0.0]))
    up /= np.linalg.norm(up)
    axes = np.stack([_cross(forward, up), up, -forward])
    return projection @ inverse_pose(data.light_xpos[light], axes)


def _cross(one: Array, other: Array) -> Array:
    """Return the cross product (3,), a tenth of the time of numpy's."""
    product = np.empty(3)
    mujoco.mju_cross(product, one, other)
    return product
