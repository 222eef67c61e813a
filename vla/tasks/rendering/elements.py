"""Drawn elements of a model: geoms and sites as one table."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.rendering.renderer import Views

OPAQUE = 0.995  # smallest alpha of an opaque element in MuJoCo
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # of a geom that shows its material's colour
RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


@dataclass(frozen=True)
class Elements:
    """Appearance of all geoms, then all sites of a model; rows (E, …)."""

    kind: Array  # (E,) mjtGeom
    mesh: Array  # (E,) id of the mesh, or -1
    size: Array  # (E, 3) half sizes along x, y and z [m]
    rgba: Array  # (E, 4)
    material: Array  # (E,) id, or -1
    texture: Array  # (E,) id, or -1
    light: Array  # (E, 3) emission, specular, shininess
    seen: Array  # (E,) bool

    @property
    def opaque(self) -> Array:
        """Mask (E,) of the elements that are drawn without blending."""
        return self.seen & (self.rgba[:, 3] >= OPAQUE)


def elements_of(model: mujoco.MjModel, views: Views) -> Elements:
    """Read the elements' present appearance from a model."""
    kind, material, rgba, size, group = (
        np.concatenate([getattr(model, f"geom_{name}"), getattr(model, f"site_{name}")])
        for name in ("type", "matid", "rgba", "size", "group")
    )
    mesh = np.concatenate([model.geom_dataid, np.full(model.nsite, -1, np.int32)])
    light, texture = np.tile(np.array([0.0, 0.5, 0.5], np.float32), (len(kind), 1)), np.full(len(kind), -1, np.int32)
    with_material = np.flatnonzero(material >= 0)
    if len(with_material):
        chosen = material[with_material]
        plain = (rgba[with_material] == np.array(DEFAULT_RGBA, np.float32)).all(axis=1)
        rgba[with_material[plain]] = model.mat_rgba[chosen[plain]]
        names = ("mat_emission", "mat_specular", "mat_shininess")
        light[with_material] = np.stack([getattr(model, name)[chosen] for name in names], axis=1)
        texture[with_material] = model.mat_texid[chosen, RGB_ROLE]
    group = np.clip(group, 0, mujoco.mjNGROUP - 1)
    shown = np.isin(group, list(views.geom_groups))
    shown[model.ngeom :] = np.isin(group[model.ngeom :], list(views.site_groups))
    # MuJoCo's sizes start with the radius of round shapes.
    size = size.astype(np.float32)
    round_ = np.isin(kind, (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER))
    size[round_] = size[round_][:, [0, 0, 1]]
    ball = kind == mujoco.mjtGeom.mjGEOM_SPHERE
    size[ball] = size[ball][:, [0, 0, 0]]
    return Elements(kind, mesh, size, rgba, material, texture, light, shown & (rgba[:, 3] > 0))


def unsupported(model: mujoco.MjModel, views: Views) -> list[str]:
    """Name what MuJoCo's renderer would draw of a model and the fast one does not."""
    elements = elements_of(model, views)
    infinite = (elements.kind == mujoco.mjtGeom.mjGEOM_PLANE) & (elements.size[:, :2] <= 0).any(axis=1)
    sky = (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()
    odd = (mujoco.mjtLightType.mjLIGHT_POINT, mujoco.mjtLightType.mjLIGHT_IMAGE)
    drawn = elements.material[elements.seen & (elements.material >= 0)]
    present = {
        "height fields": (elements.seen & (elements.kind == mujoco.mjtGeom.mjGEOM_HFIELD)).any(),
        "skins": model.nskin,
        "flexible bodies": model.nflex,
        "spatial tendons": (model.wrap_type != mujoco.mjtWrap.mjWRAP_JOINT).any(),
        "reflections": (model.mat_reflectance[drawn] > 0).any(),
        "haze at the horizon": sky and (elements.seen & infinite).any(),
        "lights of the types point and image": np.isin(model.light_type, odd).any(),
        "textures of one or two channels": (model.tex_nchannel < 3).any(),
        "slider-cranks": (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SLIDERCRANK).any(),
    }
    return [name for name, there in present.items() if there]
