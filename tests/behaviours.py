"""Figures that may not change unnoticed: `python tests/behaviours.py FOLDER [--against FILE] [FIGURES …]`.

They are written to `behaviours.json` in FOLDER; `--against` names such a file of another commit, and every figure that
differs is printed. Digests and losses are equal on one machine only, because processors round differently.
"""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from trials import digest

ROOT = Path(__file__).parents[1]
GOALS = ("lift", "pick_place", "stack", "push", "pick_place_two", "place", "chain")
TRAIN = ("job=train", "trainer.accelerator=cpu", "validate.episodes=0", "trainer.log_every_n_steps=100")


def run(folder: Path, *arguments: str) -> str:
    """Run `python -m vla.run`, which must succeed; returns what it printed."""
    command, environment = [sys.executable, "-m", "vla.run", *arguments], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, check=True)
    return done.stdout


def demonstrations(folder: Path) -> Iterator[tuple[str, Any]]:
    """Digests of 20 demonstrations of every goal."""
    for goal in GOALS:
        run(folder, "job=collect", f"task/goal={goal}", "collect.episodes=20", f"collect.folder=goals/{goal}")
        yield goal, digest(folder / "goals" / goal, ".bin", ".json", ".jsonl")


def losses(folder: Path) -> Iterator[tuple[str, Any]]:
    """Losses up to 300 steps."""
    for model in ("bc", "rt1_tiny"):
        data = ("collect.episodes=100", "collect.folder=hundred", "trainer.max_steps=300")
        run(folder, f"model={model}", *TRAIN, *data, f"output={model}")
        with (folder / model / "metrics.csv").open() as lines:
            yield model, [float(row["train/loss"]) for row in csv.DictReader(lines) if row.get("train/loss")]


def success(folder: Path) -> Iterator[tuple[str, Any]]:
    """The success of the main job in its full size."""
    yield "main", re.findall(r"success (\d+/\d+)", run(folder, "recorder=none", "output=main"))[-1]


FIGURES = {each.__name__: each for each in (demonstrations, losses, success)}


def main() -> int:
    """Find the figures that are named, by default all; returns the exit status."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=[*FIGURES], metavar="FIGURES", help=", ".join(FIGURES))
    parser.add_argument("--against", type=Path)
    asked = parser.parse_intermixed_args()
    asked.folder.mkdir(parents=True)
    found = {f"{name} of {of}": value for name in asked.names for of, value in FIGURES[name](asked.folder.resolve())}
    (asked.folder / "behaviours.json").write_text(json.dumps(found, indent=1))
    before = json.loads(asked.against.read_text()) if asked.against else {}
    differ = [name for name, value in before.items() if name in found and found[name] != value]
    for name in differ:
        print(f"differs: {name}\n  {before[name]}\n  {found[name]}")
    return bool(differ)


if __name__ == "__main__":
    sys.exit(main())
