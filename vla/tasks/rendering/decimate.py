"""Meshes with fewer faces for pictures, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

import numpy as np

from vla.spec import Array

METHOD = "fast-simplification 0.2"  # part of the content's name: another method gives other faces


def decimate(vertices: Array, faces: Array, most: int) -> tuple[Array, Array]:
    """Return vertices (V, 3) float32 and at most about `most` faces (F, 3) int32 near a mesh's surface."""
    content = hashlib.sha256(f"{METHOD} {most} {len(vertices)}".encode())
    content.update(np.ascontiguousarray(vertices, np.float32).tobytes())
    content.update(np.ascontiguousarray(faces, np.int32).tobytes())
    path = cache_folder() / f"{content.hexdigest()[:32]}.npz"
    try:
        with np.load(path) as kept:
            return kept["vertices"], kept["faces"]
    except (OSError, ValueError, KeyError):
        pass  # not there yet, or cut off
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


def _keep(path: Path, vertices: Array, faces: Array) -> None:
    """Write the file at once, as other processes may read it; without room for it, do without."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".npz", delete=False) as file:
            np.savez(file, vertices=vertices, faces=faces)
        os.replace(file.name, path)
    except OSError:
        return
