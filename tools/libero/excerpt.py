"""Make the small file that the tests compare with: `python excerpt.py OUT ../../tests/libero_reference.npz`.

OUT is the folder of reference.py. Kept are the arm's joints of three tasks and twenty judgements of each of five, with
every kind of predicate, half of them true where there are as many.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

MOVED = ("libero_object_3", "libero_goal_9", "libero_10_9")
JUDGED = ("libero_spatial_0", "libero_goal_0", "libero_10_2", "libero_10_3", "libero_10_9")
STEPS, STATES = 60, 20


def balanced(holds: np.ndarray) -> np.ndarray:
    """Return rows of states, first those of the rarer judgements of each predicate (N, P)."""
    rare = np.where(holds.mean(axis=0) < 0.5, holds, ~holds).any(axis=1)
    return np.sort(np.concatenate([np.flatnonzero(rare)[: STATES // 2], np.flatnonzero(~rare)])[:STATES])


def main() -> None:
    """Write the file."""
    folder, arrays = Path(sys.argv[1]), {}
    for name in MOVED:
        with np.load(folder / f"{name}.npz") as reference:
            arrays[f"{name} commands"] = reference["commands"][:STEPS]
            arrays[f"{name} joints"] = reference["joints"][:STEPS, :7]
    for name in JUDGED:
        with np.load(folder / f"{name}.npz") as reference:
            rows = balanced(reference["holds"])
            arrays[f"{name} positions"] = reference["positions"][rows].astype(np.float32)
            arrays[f"{name} holds"] = reference["holds"][rows]
    np.savez_compressed(sys.argv[2], **arrays)


if __name__ == "__main__":
    main()
