"""Writes what the tests compare with."""

from __future__ import annotations

from safetensors.torch import load_file, save_file
from tiny_vla import REFERENCE, deviation
from torch import Tensor

TOLERANCE = 1e-5


def write(name: str, results: dict[str, Tensor]) -> None:
    """Write results, and compare them with those that were there; delete these before what is compared changes."""
    path = REFERENCE / f"{name}.safetensors"
    for key, reference in load_file(path).items() if path.exists() else ():
        error = deviation(results[key].detach(), reference)
        print(f"{name}: {key:70} {error:.1e}")
        assert error <= TOLERANCE, key
    save_file({key: value.detach().contiguous().clone() for key, value in results.items()}, path)
