"""Triangles of MuJoCo's shapes, tessellated and textured as MuJoCo does."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from vla.spec import Array

SMOOTH = 0.8  # smallest cosine between a mesh's normal at a vertex and that of a face that is shaded smoothly
VERTEX = ("position", "normal", "texcoord", "raw")  # what a `Surface` has of every vertex
WELD = 1e-6  # largest distance between vertices at the same place, relative to the shape's size


@dataclass(frozen=True)
class Outline:
    """A shape's triangles without repetition of vertices at the same place."""

    vertices: Array  # (W,) one vertex of the shape for each place
    triangles: Array  # (T, 3) int32, indices of places, none without an area
    closed: bool  # whether the triangles enclose a volume


@dataclass(frozen=True)
class Surface:
    """Triangles with normals and texture coordinates."""

    position: Array  # (V, 3) [m]
    normal: Array  # (V, 3), of length 1
    texcoord: Array  # (V, 2), 0…1 over the shape
    raw: Array  # (V, 3) position before scaling, the direction in a cube texture
    triangles: Array  # (T, 3) int32, indices of vertices, counterclockwise from outside
    source: Surface | None = None  # the shape that this one is a stretched copy of

    def scale(self, size: Array) -> Surface:
        """Return the shape stretched by `size` (3,)."""
        normal = self.normal / size
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return Surface(self.position * size, normal, self.texcoord, self.raw, self.triangles, self)

    @cached_property
    def outline(self) -> Outline:
        """The outline, which stretching does not change."""
        if self.source is not None:
            return self.source.outline
        steps = np.rint(self.position / (WELD * max(np.abs(self.position).max(initial=0.0), 1e-9)))
        _, indices, inverse = np.unique(steps, axis=0, return_index=True, return_inverse=True)
        triangles = inverse.reshape(-1)[self.triangles].astype(np.int32)
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        return Outline(indices, triangles, _is_closed(self.position[indices].astype(np.float32), triangles))


def _is_closed(position: Array, triangles: Array) -> bool:
    """Return whether triangles (T, 3) of positions (W, 3) enclose a volume, and face away from it.

    Every edge must occur equally often in both directions.
    """
    if not len(triangles):
        return False
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    forward, backward = (np.sort(edges[:, start] * len(position) + edges[:, 1 - start]) for start in (0, 1))
    corners = position[triangles] - position[triangles[0, 0]]
    volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return bool(volume > 0 and (forward == backward).all())


def join(*shapes: Surface) -> Surface:
    """Join several shapes into one."""
    starts = np.cumsum([0, *(len(shape.position) for shape in shapes)])
    position, normal, texcoord, raw = (np.concatenate([getattr(shape, name) for shape in shapes]) for name in VERTEX)
    triangles = np.concatenate([shape.triangles + start for shape, start in zip(shapes, starts, strict=False)])
    return Surface(position, normal, texcoord, raw, triangles)


def _patch(rows: int, columns: int) -> tuple[Array, Array, Array]:
    """Return row and column numbers of a grid's vertices, and its triangles, of `rows` times `columns` cells."""
    row, column = (axis.ravel() for axis in np.mgrid[: rows + 1, : columns + 1])
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, above = corner + 1, corner + columns + 1
    triangles = np.concatenate([np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)])
    return row, column, triangles.astype(np.int32)


def sphere(slices: int, stacks: int, low: float = -1.0, high: float = 1.0) -> Surface:
    """Return the unit sphere between two elevations [quarter turns], with `stacks` rows."""
    row, column, triangles = _patch(stacks, slices)
    elevation, azimuth = np.pi / 2 * (low + (high - low) * row / stacks), 2 * np.pi * column / slices
    ring = np.where(np.isclose(np.abs(elevation), np.pi / 2), 0.0, np.cos(elevation))
    position = np.stack([np.cos(azimuth) * ring, np.sin(azimuth) * ring, np.sin(elevation)], 1)
    u = np.where(ring == 0, column + 0.5, column) / slices
    first, second, third = (position[triangles[:, corner]] for corner in range(3))
    flat = np.linalg.norm(np.cross(second - first, third - first), axis=1) < 1e-9  # at the poles
    return Surface(position, position, np.stack([u, 1 - row / stacks], 1), position, triangles[~flat])


def tube(slices: int) -> Surface:
    """Return an open cylinder of radius 1 from z = -1 to 1."""
    row, column, triangles = _patch(1, slices)
    azimuth = 2 * np.pi * column / slices
    position = np.stack([np.cos(azimuth), np.sin(azimuth), 2.0 * row - 1], 1)
    texcoord = np.stack([column / slices, 1.0 - row], 1)
    return Surface(position, position * [1, 1, 0], texcoord, position, triangles)


def disk(slices: int, side: int) -> Surface:
    """Return a disk of radius 1 at z = side, -1 or 1, that faces away from the origin."""
    azimuth = 2 * np.pi * np.arange(slices) / slices
    rim = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(slices, float(side))], 1)
    position = np.concatenate([[[0.0, 0.0, side]], rim])
    index = np.arange(slices)
    triangles = np.stack([np.zeros(slices, int), 1 + index, 1 + (index + 1) % slices], 1)[:, ::side]
    normal = np.tile([0.0, 0.0, side], (slices + 1, 1))
    return Surface(position, normal, 0.5 + 0.5 * position[:, :2], position, triangles.astype(np.int32))


def cylinder(slices: int) -> Surface:
    """Return a closed cylinder of radius 1 from z = -1 to 1."""
    return join(disk(slices, -1), tube(slices), disk(slices, 1))


def capsule(slices: int, stacks: int, radius: float, half_length: float) -> Surface:
    """Return a capsule along z [m]."""
    parts = [tube(slices).scale(np.array([radius, radius, half_length]))]
    for side in (-1, 1):
        cap = sphere(slices, stacks // 2, *sorted((0.0, float(side))))
        # Texture coordinates run from one pole to the equator and again from there.
        position = cap.position * radius + [0, 0, side * half_length]
        parts.append(Surface(position, cap.normal, cap.texcoord, cap.raw + np.array([0, 0, side]), cap.triangles))
    return join(*parts)


def box() -> Surface:
    """Return the cube from -1 to 1."""
    faces = []
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    for axis, (first, second), orientation in ((2, (0, 1), 1), (0, (1, 2), 1), (1, (0, 2), -1)):
        for side in (-1, 1):
            position, normal = np.full((4, 3), float(side)), np.zeros((4, 3))
            position[:, first], position[:, second], normal[:, axis] = corners[:, 0], corners[:, 1], side
            triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)[:, :: side * orientation]
            faces.append(Surface(position, normal, 0.5 + corners * [0.5, -0.5], position, triangles))
    return join(*faces)


def plane(half_x: float, half_y: float) -> Surface:
    """Return a rectangle in the plane z = 0 that faces along z; lengths in [m]."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    position = np.concatenate([corners * [half_x, half_y], np.zeros((4, 1))], 1)
    normal = np.tile([0.0, 0.0, 1.0], (4, 1))
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Surface(position, normal, 0.5 + corners * [0.5, -0.5], position, triangles)


def mesh_triangles(model: mujoco.MjModel, mesh: int) -> tuple[Array, Array]:
    """Return a mesh's vertices (V, 3) [m] and faces (F, 3)."""
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    return vertices, model.mesh_face[face : face + model.mesh_facenum[mesh]]


def mesh_texcoord(model: mujoco.MjModel, mesh: int) -> Array | None:
    """Return the texture coordinates (F, 3 corners, 2) of a mesh's faces, or None if it has none."""
    face, start = model.mesh_faceadr[mesh], model.mesh_texcoordadr[mesh]
    if start < 0:
        return None
    return model.mesh_texcoord[start + model.mesh_facetexcoord[face : face + model.mesh_facenum[mesh]]]


def mesh(model: mujoco.MjModel, number: int) -> Surface:
    """Return a model's mesh with its normals; without texture coordinates, sharp edges get the faces' normals."""
    vertices, faces = mesh_triangles(model, number)
    start, stop = model.mesh_faceadr[number], model.mesh_faceadr[number] + model.mesh_facenum[number]
    corners = vertices[faces]  # (F, 3 corners, 3)
    normals = model.mesh_normal[model.mesh_normaladr[number] + model.mesh_facenormal[start:stop]]
    texcoord = mesh_texcoord(model, number)
    if texcoord is None:
        return _share_vertices(corners, _sharpen(corners, normals), np.zeros((*corners.shape[:2], 2), np.float32))
    return _share_vertices(corners, normals, texcoord)


def smooth_surface(vertices: Array, faces: Array, texcoord: Array) -> Surface:
    """Return the surface of vertices (V, 3) and faces (F, 3) with texture coordinates (F, 3 corners, 2), with normals
    that are averaged over adjacent faces except at sharp edges."""
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    vertex_normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(vertex_normals, faces[:, corner], face_normals)
    vertex_normals /= np.maximum(np.linalg.norm(vertex_normals, axis=1, keepdims=True), 1e-20)
    return _share_vertices(corners, _sharpen(corners, vertex_normals[faces]), texcoord)


def _sharpen(corners: Array, normals: Array) -> Array:
    """Return normals (F, 3, 3), replaced by the face's own one where they deviate much from it."""
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-20)
    is_smooth = np.einsum("fci,fi->fc", normals, face_normals) >= SMOOTH
    return np.where(is_smooth[:, :, None], normals, face_normals[:, None])


def _share_vertices(corners: Array, normals: Array, texcoord: Array) -> Surface:
    """Return the surface of arrays (F, 3 corners, …), with equal vertices shared by its triangles."""
    rows = np.concatenate([corners, normals, texcoord], axis=2).reshape(-1, 8).astype(np.float32)
    rows = np.ascontiguousarray(rows + 0.0)  # no negative zeros
    records = rows.view(np.dtype((np.void, rows.itemsize * 8)))
    _, indices, inverse = np.unique(records, return_index=True, return_inverse=True)
    table = rows[indices]
    return Surface(table[:, :3], table[:, 3:6], table[:, 6:], table[:, :3], inverse.reshape(-1, 3).astype(np.int32))
