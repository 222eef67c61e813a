"""Meshes with fewer faces for pictures, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import zlib
from contextlib import suppress
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from vla.io.files import atomic_path
from vla.spec import Array

METHOD = "fast-simplification 0.2"  # part of the cache key: another method gives other faces
Mesh = tuple[Array, Array, Array]  # vertices (V, 3) float32, faces (F, 3) int32, texture coordinates (F, 3 corners, 2)


def decimate(vertices: Array, faces: Array, texcoord: Array | None, max_faces: int) -> Mesh:
    """Simplify a mesh to at most about `max_faces` faces, with its texture in the same places.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices of vertices.
        texcoord: (F, 3 corners, 2), or None.
        max_faces: number of faces.
    """
    vertices, faces = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32)
    content = hashlib.sha256(f"{METHOD} {max_faces} {len(vertices)}".encode() + vertices.tobytes() + faces.tobytes())
    content.update(b"" if texcoord is None else np.ascontiguousarray(texcoord, np.float32).tobytes())
    path = cache_folder() / f"{content.hexdigest()[:32]}.npz"
    with suppress(OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error), np.load(path) as archive:
        return archive["vertices"], archive["faces"], archive["texcoord"]
    result = _simplify(vertices, faces, texcoord, max_faces)
    # Written atomically, as other processes may read it; without disk space, the mesh is not cached.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            np.savez(draft, vertices=result[0], faces=result[1], texcoord=result[2])
    return result


def cache_folder() -> Path:
    """Return the folder of simplified meshes."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vla" / "meshes"


def _simplify(vertices: Array, faces: Array, texcoord: Array | None, count: int) -> Mesh:
    from fast_simplification import replay_simplification, simplify

    points, triangles, collapses = simplify(vertices, faces, target_count=count, return_collapses=True)
    points, triangles = np.asarray(points, np.float32), np.asarray(triangles, np.int32)
    if texcoord is None:
        return points, triangles, np.zeros((*triangles.shape, 2), np.float32)
    positions, _, target = replay_simplification(vertices, faces, collapses)
    triangles = target[faces]  # every remaining face is an original one with its corners moved
    a, b, c = triangles.T
    mask = (a != b) & (b != c) & (c != a)
    distance = np.linalg.norm(vertices - positions[target], axis=1)
    coordinates = _transfer(faces, np.asarray(texcoord, np.float32), target, distance)
    return np.asarray(positions, np.float32), triangles[mask].astype(np.int32), coordinates[mask]


def _transfer(faces: Array, texcoord: Array, target: Array, distance: Array) -> Array:
    """Return the texture coordinates (F, 3, 2) of the corners of faces after their vertices were merged.

    A corner gets the mean over the vertices that were merged into one, weighted by 1 / distance². Where a texture seam
    runs through these, only those on the corner's side of it count: those connected to it by edges among them.

    Args:
        faces: (F, 3) indices of vertices.
        texcoord: (F, 3, 2) before.
        target: (V,) vertex that each vertex was merged into.
        distance: (V,) of each vertex from where it was moved.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corners = np.column_stack([faces.ravel(), texcoord.reshape(-1, 2)])
    places, index = np.unique(corners, axis=0, return_inverse=True)  # vertices, those on a seam once per side
    index = index.reshape(faces.shape)
    starts, ends = index.ravel(), np.roll(index, -1, axis=1).ravel()
    mask = target[faces].ravel() == target[np.roll(faces, -1, axis=1)].ravel()
    edges = np.ones(mask.sum(), bool), (starts[mask], ends[mask])
    label = connected_components(coo_array(edges, shape=(len(places),) * 2), directed=False)[1]
    weight = 1 / (distance[places[:, 0].astype(int)] ** 2 + 1e-12)
    means = [np.bincount(label, weight * values) / np.bincount(label, weight) for values in places[:, 1:].T]
    return np.stack(means, axis=1)[label[index]].astype(np.float32)
