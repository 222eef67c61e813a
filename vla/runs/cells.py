"""A sweep's folder on disk: its cells, what distinguishes them, and why they failed.

A cell is the run folder of one job of the sweep.
"""

from __future__ import annotations

from pathlib import Path

from vla.io.documents import read_bounded, read_yaml
from vla.io.files import write_text

OVERRIDES = ".hydra/overrides.yaml"  # written by Hydra in the folder of every cell
FAILURE = "error.txt"  # in the folder of a failed cell


def save_failure(cell: Path, reason: str) -> None:
    """Save why a cell failed; the list of failures quotes the first line."""
    write_text(cell / FAILURE, f"{reason}\n")


def describe_failures(folder: Path) -> str:
    """Return the number of failed cells of a sweep, and a line for each."""
    failed, started = failures(folder), len(cells(folder, OVERRIDES))
    return "\n  ".join([f"{len(failed)} of {started} cells failed, see {FAILURE} of each in {folder}", *failed])


def failures(folder: Path) -> list[str]:
    """Describe the failed cells of a sweep: name, choices and reason of each."""
    choices_of = {cell: overrides_of(cell) for cell in cells(folder, OVERRIDES)}
    varied = varied_keys(list(choices_of.values()))
    lines = []
    for cell in cells(folder, FAILURE):
        choices = "".join(f" {key}={choices_of[cell][key]}" for key in varied if key in choices_of[cell])
        reason = read_bounded(cell / FAILURE).decode("utf-8", "replace").partition("\n")[0]
        lines.append(f"{cell.name}{choices}: {reason}")
    return lines


def cells(folder: Path, having: str) -> list[Path]:
    """Return the cells that contain the file `having`, in the order of the sweep."""
    found = [cell for cell in folder.iterdir() if (cell / having).exists()]
    return sorted(found, key=lambda cell: (len(cell.name), cell.name))


def overrides_of(cell: Path) -> dict[str, str]:
    """Return key → value of a cell's command line."""
    pairs = (override.partition("=") for override in read_yaml(cell / OVERRIDES, list[str]))
    return {key.lstrip("+~"): value for key, _, value in pairs}


def varied_keys(choices: list[dict[str, str]]) -> list[str]:
    """Return the overrides that differ between cells."""
    keys = dict.fromkeys(key for overrides in choices for key in overrides)
    return [key for key in keys if len({overrides.get(key) for overrides in choices}) > 1]
