"""LIBERO's scenes as models small enough to keep many of them: the same physics, smaller meshes and textures.

Each distinct scene is compiled once and kept in the user's cache folder. Only meshes without collisions are simplified,
and LIBERO's masses come from the other geoms alone, so the physics does not change.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
from annotated_types import Ge
from PIL import Image

from vla.io.errors import UserError
from vla.io.files import atomic_path
from vla.spec import Array
from vla.tasks.libero.package import scene_xml
from vla.tasks.rendering.decimate import cache_folder, decimate
from vla.tasks.rendering.shapes import mesh_texcoord, mesh_triangles

VISIBLE = 1  # group of the geoms that are drawn; collisions are in group 0
BURNER = "_burner"  # end of the name of a stove's glowing plate, a site
WELD = 1e-6  # [m]
METHOD = "without highlights on broad faces, more faces of fine things"  # part of the cache key
BROAD = 0.1  # area of a face above which MuJoCo, which lights vertices, shows no highlight within it [m²]
FINE = 4  # a finely structured thing, such as a woven basket, keeps one of so many faces if that exceeds its detail
MOST = 3  # but at most so many times its detail

Faces = Annotated[int, Ge(100)]


@dataclass(frozen=True)
class Detail:
    """Level of detail of a scene's pictures: the config node `task.detail`."""

    things: Faces  # most faces of a mesh of a movable thing; up to MOST times as many for fine structures
    robot: Faces  # most faces of a mesh of the robot
    rest: Faces  # most faces of any other mesh
    texels: Annotated[int, Ge(16)]  # largest edge of a texture


def load_scene(name: str, things: Collection[str], detail: Detail | None) -> mujoco.MjModel:
    """Return the model of a scene, which is compiled in some seconds the first time, and then cached.

    Args:
        name: of the scene, as in `Task.scene`.
        things: names of the movable things, whose meshes keep the most faces.
        detail: of the pictures; None: collision geometry only, a hundredth of the size.

    Raises:
        UserError: this MuJoCo cannot compile it.
    """
    key = f"{METHOD} {name} {sorted(things)} {detail} {mujoco.__version__}"
    path = cache_folder().parent / "libero" / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.mjb"
    if path.is_file():
        with suppress(ValueError):  # it is damaged
            return mujoco.MjModel.from_binary_path(str(path))
    try:
        model = _light(scene_xml(name), things, detail)
    except ValueError as error:
        raise UserError(f"MuJoCo {mujoco.__version__} cannot compile a scene of LIBERO: {error}") from error
    with suppress(OSError):  # without disk space, or in a read-only folder, the scene is not cached
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            save_model(model, draft)
    return model


def save_model(model: mujoco.MjModel, path: Path) -> None:
    """Write a model; an OSError if the disk is full, where MuJoCo's own function only warns."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    path.write_bytes(content.data)


def _light(xml: str, things: Collection[str], detail: Detail | None) -> mujoco.MjModel:
    if detail is None:
        return _collision_model(xml)
    model, spec = mujoco.MjSpec.from_string(xml).compile(), mujoco.MjSpec.from_string(xml)
    meshes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    solid = {geom.meshname for geom in meshes if geom.contype or geom.conaffinity}
    for name in sorted({geom.meshname for geom in meshes} - solid):  # the order of a set differs between processes
        limit = detail.rest
        if name.startswith(("robot0_", "gripper0_")):
            limit = detail.robot
        if name.startswith(tuple(things)):
            count = int(model.mesh_facenum[model.mesh(name).id]) // FINE
            limit = min(max(detail.things, count), MOST * detail.things)
        users = [geom for geom in meshes if geom.meshname == name]
        if _largest_face(model, model.mesh(name).id) > BROAD:
            for material in {geom.material for geom in users} - {""}:
                spec.material(material).specular = 0
        if model.mesh_facenum[model.mesh(name).id] > limit:
            _thin(spec, model, name, limit, users)
    for texture in spec.textures:
        if texture.file:
            _shrink(model, texture, detail.texels)
    return spec.compile()


def _largest_face(model: mujoco.MjModel, mesh: int) -> float:
    """Return the area of the largest face of a mesh [m²]."""
    vertices, faces = mesh_triangles(model, mesh)
    a, b, c = vertices[faces].swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).max()) / 2


def _collision_model(xml: str) -> mujoco.MjModel:
    """Compile a scene without what is only drawn."""
    spec = mujoco.MjSpec.from_string(xml)
    for geom in list(spec.geoms):
        if not (geom.contype or geom.conaffinity):
            spec.delete(geom)
    mesh_names = {geom.meshname for geom in spec.geoms}
    for geom in spec.geoms:
        geom.material = ""
    for part in [*(mesh for mesh in spec.meshes if mesh.name not in mesh_names), *spec.materials, *spec.textures]:
        spec.delete(part)
    return spec.compile()


def _thin(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str, limit: int, users: Collection[mujoco.MjsGeom]) -> None:
    """Replace a mesh by one with fewer faces, in the frame of its file, which the geoms refer to."""
    vertices, faces, texcoord = decimate(*_weld(model, model.mesh(name).id), limit)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[model.mesh(name).id])
    mesh = spec.add_mesh(name=f"{name}_light")
    mesh.uservert = (vertices @ turn.reshape(3, 3).T + model.mesh_pos[model.mesh(name).id]).ravel()
    mesh.userface = faces.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # it may have holes
    if model.mesh_texcoordadr[model.mesh(name).id] >= 0:
        rows, places = np.unique(texcoord.reshape(-1, 2), axis=0, return_inverse=True)
        mesh.usertexcoord, mesh.userfacetexcoord = rows.ravel(), places.ravel()
    for geom in users:
        geom.meshname = mesh.name
    spec.delete(spec.mesh(name))


def _weld(model: mujoco.MjModel, mesh: int) -> tuple[Array, Array, Array | None]:
    """Return vertices, faces and corners' texture coordinates of a mesh, without vertices stored once per corner.

    Thinning would otherwise take every edge for a border, and keep it.
    """
    vertices, faces = mesh_triangles(model, mesh)
    _, indices, places = np.unique(np.rint(vertices / WELD), axis=0, return_index=True, return_inverse=True)
    return vertices[indices], places.ravel()[faces], mesh_texcoord(model, mesh)


def _shrink(model: mujoco.MjModel, texture: mujoco.MjsTexture, texels: int) -> None:
    """Give a texture its pixels instead of a file's, averaged to at most `texels` along an edge."""
    number = model.texture(texture.name).id
    height, width, channels = (int(table[number]) for table in (model.tex_height, model.tex_width, model.tex_nchannel))
    start = int(model.tex_adr[number])
    pixels = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
    sides = np.split(pixels, 6 if height == 6 * width else 1)  # of a cube, one above the other
    size = min(texels, width), min(texels, len(sides[0]))
    image = np.concatenate([np.asarray(Image.fromarray(side).resize(size, Image.Resampling.BOX)) for side in sides])
    texture.file, texture.gridsize = "", [1, 1]
    texture.height, texture.width, texture.nchannel = *image.shape[:2], channels
    texture.colorspace = mujoco.mjtColorSpace(int(model.tex_colorspace[number]))  # otherwise all colours turn pale
    texture.data = image.tobytes()
