"""Writes what the tests compare with."""

from __future__ import annotations

from safetensors.torch import load_file, save_file
from tiny_vla import REFERENCE, deviation
from torch import Tensor

TOLERANCE = 1e-5


def write(name: str, results: dict[str, Tensor]) -> None:
    """Write results, and compare them with those that were there; delete these before what is compared changes."""
    path = REFERENCE / f"{name}.safetensors"
    for each, stored in load_file(path).items() if path.exists() else ():
        off = deviation(results[each].detach(), stored)
        print(f"{name}: {each:70} {off:.1e}")
        assert off <= TOLERANCE, each
    save_file({each: value.detach().contiguous().clone() for each, value in results.items()}, path)
