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

METHOD = "fast-simplification 0.2"  # part of the content's name: another method gives other faces


def decimate(vertices: Array, faces: Array, most: int) -> tuple[Array, Array]:
    """Return vertices (V, 3) float32 and at most about `most` faces (F, 3) int32 near a mesh's surface."""
    content = hashlib.sha256(f"{METHOD} {most} {len(vertices)}".encode())
    content.update(np.ascontiguousarray(vertices, np.float32).tobytes())
    content.update(np.ascontiguousarray(faces, np.int32).tobytes())
    path = cache_folder() / f"{content.hexdigest()[:32]}.npz"
    kept = _kept(path)
    if kept is not None:
        return kept
    from fast_simplification import simplify

    fewer = simplify(
        np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32), target_count=most
    )
    result = np.asarray(fewer[0], np.float32), np.asarray(fewer[1], np.int32)
    _keep(path, *result)
    return result


def cache_folder() -> Path:
    """Return the folder of simplified meshes."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vla" / "meshes"


def _kept(path: Path) -> tuple[Array, Array] | None:
    """Return vertices and faces in a file, or None if it is not there, cut off or of another kind."""
    try:
        with np.load(path) as kept:
            vertices, faces = kept["vertices"], kept["faces"]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error):
        return None
    right = (vertices.dtype, faces.dtype) == (np.float32, np.int32) and vertices.shape[1:] == faces.shape[1:] == (3,)
    indexed = right and (not faces.size or 0 <= faces.min() <= faces.max() < len(vertices))
    return (vertices, faces) if indexed and np.isfinite(vertices).all() else None


def _keep(path: Path, vertices: Array, faces: Array) -> None:
    """Write the file atomically, as other processes may read it; without room for it, do without."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            np.savez(draft, vertices=vertices, faces=faces)
