"""Drawn elements of a model, geoms and sites, and all their geometry in one vertex buffer and one index buffer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.rendering import shapes
from vla.tasks.rendering.projections import clip_range
from vla.tasks.rendering.renderer import Views
from vla.tasks.rendering.shapes import Surface

HORIZON = 1.05  # half the extent of an infinite plane over the distance of the far clipping plane, as in MuJoCo
SKY_DISTANCE = 0.7  # of the sky over the distance of the far clipping plane, as in MuJoCo
Kind = mujoco.mjtGeom
OPAQUE_ALPHA = 0.995  # smallest alpha of an opaque element in MuJoCo
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
    visible: Array  # (E,) bool

    @property
    def opaque(self) -> Array:
        """Mask (E,) of the elements that are drawn without blending."""
        return self.visible & (self.rgba[:, 3] >= OPAQUE_ALPHA)


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
        materials = material[with_material]
        is_default = (rgba[with_material] == np.array(DEFAULT_RGBA, np.float32)).all(axis=1)
        rgba[with_material[is_default]] = model.mat_rgba[materials[is_default]]
        names = ("mat_emission", "mat_specular", "mat_shininess")
        light[with_material] = np.stack([getattr(model, name)[materials] for name in names], axis=1)
        texture[with_material] = model.mat_texid[materials, RGB_ROLE]
    group = np.clip(group, 0, mujoco.mjNGROUP - 1)
    is_shown = np.isin(group, list(views.geom_groups))
    is_shown[model.ngeom :] = np.isin(group[model.ngeom :], list(views.site_groups))
    # MuJoCo's sizes start with the radius of round shapes.
    size = size.astype(np.float32)
    round_ = np.isin(kind, (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER))
    size[round_] = size[round_][:, [0, 0, 1]]
    ball = kind == mujoco.mjtGeom.mjGEOM_SPHERE
    size[ball] = size[ball][:, [0, 0, 0]]
    return Elements(kind, mesh, size, rgba, material, texture, light, is_shown & (rgba[:, 3] > 0))


def unsupported_features(model: mujoco.MjModel, views: Views) -> list[str]:
    """Name the features of a model that MuJoCo's renderer draws and the fast one does not."""
    elements = elements_of(model, views)
    is_infinite = (elements.kind == mujoco.mjtGeom.mjGEOM_PLANE) & (elements.size[:, :2] <= 0).any(axis=1)
    sky = (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()
    light_types = (mujoco.mjtLightType.mjLIGHT_POINT, mujoco.mjtLightType.mjLIGHT_IMAGE)
    materials = elements.material[elements.visible & (elements.material >= 0)]
    features = {
        "height fields": (elements.visible & (elements.kind == mujoco.mjtGeom.mjGEOM_HFIELD)).any(),
        "skins": model.nskin,
        "flexible bodies": model.nflex,
        "spatial tendons": (model.wrap_type != mujoco.mjtWrap.mjWRAP_JOINT).any(),
        "reflections": (model.mat_reflectance[materials] > 0).any(),
        "haze at the horizon": sky and (elements.visible & is_infinite).any(),
        "lights of the types point and image": np.isin(model.light_type, light_types).any(),
        "textures of one or two channels": (model.tex_nchannel < 3).any(),
        "slider-cranks": (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SLIDERCRANK).any(),
    }
    return [name for name, flag in features.items() if flag]


@dataclass(frozen=True)
class Part:
    """One element's part of a buffer."""

    vertices: Array  # (V, floats of a vertex) float32
    triangles: Array  # (T, 3) int32, from 0


class Buffers:
    """Vertices and indices of all elements, one after the other, uploaded again only if one has changed."""

    def __init__(self, gl: Any) -> None:
        self.vertices, self.indices = gl.buffer(reserve=4), gl.buffer(reserve=4)
        self._parts: list[Part] = []

    def update(self, parts: Sequence[Part]) -> None:
        """Write the parts, unless they are the same objects as the last time."""
        changed = [*map(id, parts)] != [*map(id, self._parts)]
        self._parts = list(parts)
        if changed and parts:
            starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
            indices = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
            content = np.concatenate([part.vertices for part in parts]), np.concatenate(indices, dtype=np.int32)
            for buffer, values in zip((self.vertices, self.indices), content, strict=True):
                buffer.orphan(values.nbytes)
                buffer.write(values)


@dataclass(frozen=True)
class ElementTriangles:
    """One element's triangles."""

    element: int
    key: tuple[Any, ...]  # what its vertices depend on
    visible: Part  # with vertices of position, normal, texture coordinates or direction, element: 10 floats
    casting: Part  # with vertices of position and element, 4 floats, shared by all triangles at the same place
    closed: bool  # whether the triangles enclose a volume
    radius: float  # of the smallest sphere around the element's origin that contains it [m]


class Geometry:
    """Triangles of the drawn elements: opaque ones sorted by texture, planes last, then the sky, transparent ones."""

    def __init__(self, model: mujoco.MjModel, mesh: Callable[[int, bool], Surface]) -> None:
        """Take the model, and a function from a mesh's id and whether it is textured to its triangles."""
        self._model, self._mesh = model, mesh
        self._far = clip_range(model)[1]
        quality = model.vis.quality
        self._slices, self._stacks = int(quality.numslices), int(quality.numstacks)
        self._sphere, self._box = shapes.sphere(self._slices, self._stacks // 2 * 2), shapes.box()
        self._cylinder = shapes.cylinder(self._slices)
        self._reach = np.append(model.geom_rbound, model.site_size.max(axis=1))
        self._cache: dict[int, ElementTriangles] = {}  # element → its present triangles
        self.elements: list[ElementTriangles] = []

    def update(self, elements: Elements, sky: bool) -> None:
        """Make the triangles of the elements' current shapes; unchanged ones remain the same objects."""
        opaque = np.flatnonzero(elements.opaque)
        planes = elements.kind == Kind.mjGEOM_PLANE
        # Small elements first: large ones are mostly behind them, and drawing hidden surfaces costs little.
        order = opaque[np.lexsort((opaque, self._reach[opaque], elements.texture[opaque], planes[opaque]))]
        transparent = [
            self._shape(elements, int(index)) for index in np.flatnonzero(elements.visible & ~elements.opaque)
        ]
        solid = [self._shape(elements, int(element)) for element in order]
        if sky:
            solid.append(self._sky(len(elements.kind)))
        solid = [shape for shape in solid if len(shape.visible.triangles)]
        self.solid_count = len(solid)
        self.elements = [*solid, *(shape for shape in transparent if len(shape.visible.triangles))]

    def _shape(self, elements: Elements, element: int) -> ElementTriangles:
        model, material, texture = self._model, int(elements.material[element]), int(elements.texture[element])
        mapping = (*model.mat_texrepeat[material], int(model.mat_texuniform[material])) if texture >= 0 else ()
        kind, mesh = int(elements.kind[element]), int(elements.mesh[element])
        key = (kind, mesh, elements.size[element].tobytes(), texture, *mapping)
        entry = self._cache.get(element)
        if entry is None or entry.key != key:
            surface = self._surface(kind, mesh, elements.size[element].astype(float), texture >= 0)
            coordinates = self._coordinates(surface, kind, mesh, elements.size[element], texture, mapping)
            entry = self._cache[element] = _pack(element, key, surface, coordinates)
        return entry

    def _surface(self, kind: int, mesh: int, size: Array, textured: bool) -> Surface:
        if kind in (Kind.mjGEOM_SPHERE, Kind.mjGEOM_ELLIPSOID):
            return self._sphere.scale(size)
        if kind == Kind.mjGEOM_BOX:
            return self._box.scale(size)
        if kind == Kind.mjGEOM_CYLINDER:
            return self._cylinder.scale(size)
        if kind == Kind.mjGEOM_CAPSULE:
            return shapes.capsule(self._slices, self._stacks, size[0], size[2])
        if kind == Kind.mjGEOM_PLANE:
            return shapes.plane(*(half if half > 0 else HORIZON * self._far for half in size[:2]))
        if kind in (Kind.mjGEOM_MESH, Kind.mjGEOM_SDF) and mesh >= 0:
            return self._mesh(mesh, textured)
        no_points = np.empty((0, 3))
        return Surface(no_points, no_points, no_points[:, :2], no_points, np.empty((0, 3), np.int32))

    def _coordinates(
        self, surface: Surface, kind: int, mesh: int, size: Array, texture: int, mapping: tuple[float, ...]
    ) -> Array:
        """Return texture coordinates (V, 3): two for a plane picture, a direction for a cube."""
        if texture < 0:
            return np.zeros((len(surface.position), 3))
        if self._model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
            return surface.raw * (size if mapping[2] else 1.0)
        repeat = np.array([factor if factor > 0 else 1.0 for factor in mapping[:2]])
        extent = np.where(size[:2] > 0, size[:2], 1.0)
        if kind == Kind.mjGEOM_PLANE and (size[:2] <= 0).any():
            flat = np.where(size[:2] > 0, surface.texcoord, surface.position[:, :2] * [0.5, -0.5])
            flat = flat * repeat * (extent if mapping[2] else 1.0) - 0.5
        elif mesh < 0 or self._model.mesh_texcoordadr[mesh] >= 0:
            flat = surface.texcoord * repeat * (extent if mapping[2] else 1.0)
        else:  # projected along z
            flat = surface.position[:, :2] * [0.5, -0.5] * repeat / (1.0 if mapping[2] else extent) - 0.5
        return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)

    def _sky(self, element: int) -> ElementTriangles:
        """Return the cylinder around the camera that shows the sky, seen from inside."""
        if element not in self._cache:
            cylinder = self._cylinder
            position = cylinder.position * SKY_DISTANCE * self._far
            surface = replace(cylinder, position=position, triangles=cylinder.triangles[:, ::-1])
            self._cache[element] = _pack(element, (), surface, cylinder.raw[:, [0, 2, 1]] * [1, 1, -1])
        return self._cache[element]


def _pack(element: int, key: tuple[Any, ...], surface: Surface, coordinates: Array) -> ElementTriangles:
    number = np.full((len(surface.position), 1), element)
    vertices = np.concatenate([surface.position, surface.normal, coordinates, number], axis=1, dtype=np.float32)
    outline = surface.outline
    places = np.concatenate([surface.position[outline.vertices], number[: len(outline.vertices)]], axis=1)
    seen = Part(vertices, np.ascontiguousarray(surface.triangles, np.int32))
    casting = Part(places.astype(np.float32), outline.triangles)
    radius = float(np.sqrt(np.square(surface.position).sum(axis=1).max(initial=0.0)))
    return ElementTriangles(element, key, seen, casting, outline.closed, radius)
