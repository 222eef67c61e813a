"""Meshes with fewer faces, and the files that keep them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vla.tasks.rendering.decimate import decimate


def test_a_damaged_file_of_the_cache_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    grid = np.stack([*np.meshgrid(range(12), range(12)), np.zeros((12, 12))], axis=2).reshape(-1, 3)
    corners = [(i, i + 1, i + 12) for i in range(131) if i % 12 < 11]
    vertices, faces = decimate(grid, np.array(corners), 50)
    (path,) = (tmp_path / "vla/meshes").iterdir()
    whole = path.read_bytes()
    damages = {"empty": b"", "half": whole[: len(whole) // 2], "text": b"[1]"}
    damages["flipped"] = bytes([*whole[:400], whole[400] ^ 1, *whole[401:]])
    for other in (
        (vertices, faces + len(vertices)),
        (vertices * np.nan, faces),
        (vertices[:, :2], faces),
        (faces, faces),
    ):
        np.savez(tmp_path / "other.npz", vertices=other[0], faces=other[1])
        damages[str(len(damages))] = (tmp_path / "other.npz").read_bytes()
    np.savez(tmp_path / "other.npz", vertices=vertices)
    damages["no faces"] = (tmp_path / "other.npz").read_bytes()
    for damage in damages.values():
        path.write_bytes(damage)
        again = decimate(grid, np.array(corners), 50)
        np.testing.assert_array_equal(again[0], vertices)
        np.testing.assert_array_equal(again[1], faces)
        assert path.read_bytes() == whole and [*path.parent.iterdir()] == [path]
