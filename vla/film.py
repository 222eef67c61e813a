"""Rollouts read back from a recording as strips of pictures: a few moments of an episode, through every camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader, StoreEntry

MOMENTS = 8  # pictures of a strip
FACTS, WORDS, CAMERAS = "/__properties/episode", "/instruction", "/camera/**"


@dataclass(frozen=True)
class Strip:
    """An episode in a few pictures."""

    seed: int
    outcome: str
    instruction: str
    length: int  # of the episode [steps]
    steps: list[int]  # when the pictures were taken
    pictures: dict[str, list[bytes]]  # camera → one JPEG per step


def read_strips(file: Path, failures: int, successes: int) -> list[Strip]:
    """Strips of at most so many episodes of a file that `vla.record` wrote, failures first.

    Among the failures, every kind of outcome comes once before any comes twice.

    Raises:
        ValueError: the file cannot be read.
    """
    try:
        reader = RrdReader(file)
        return [_strip(reader, entry) for entry in _chosen(reader.recordings(), failures, successes)]
    except (RuntimeError, KeyError, ValueError) as error:  # the library's, and those of recordings of something else
        raise ValueError(f"{file} cannot be read, remove it to do without pictures: {error}") from error


def _chosen(entries: Sequence[StoreEntry], failures: int, successes: int) -> list[StoreEntry]:
    failed, succeeded = [], []
    seen: Counter[str] = Counter()
    for entry in sorted(entries, key=lambda entry: entry.recording_id):
        kind, _, *outcome = entry.recording_id.split("-")[:-1]  # see `vla.record.recording_name`
        if kind == "success":
            succeeded.append(entry)
        else:
            failed.append((seen["-".join(outcome)], entry))
            seen["-".join(outcome)] += 1
    failed.sort(key=lambda one: one[0])
    return [*(entry for _, entry in failed[:failures]), *succeeded[:successes]]


def _strip(reader: RrdReader, entry: StoreEntry) -> Strip:
    facts: dict[str, Any] = {}
    frames: dict[str, dict[int, Any]] = {}  # camera → step → blob
    for chunk in reader.store(store=entry).stream().filter(content=[FACTS, WORDS, CAMERAS]).to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path.startswith("/camera/"):
            _, _, camera, kind = chunk.entity_path.split("/")
            if kind == "rgb":
                blobs = zip(batch.column("step").to_pylist(), batch.column("EncodedImage:blob"), strict=True)
                frames.setdefault(camera, {}).update(blobs)
        else:
            facts.update({name: values[0] for name, values in batch.to_pydict().items()})
    steps = sorted(next(iter(frames.values()), {}))
    chosen = [steps[place] for place in np.linspace(0, len(steps) - 1, min(MOMENTS, len(steps))).round().astype(int)]
    pictures = {camera: [bytes(at[step][0].as_py()) for step in chosen] for camera, at in frames.items()}
    heading = facts["TextDocument:text"][0].partition("\n")[0].removeprefix("### ")
    return Strip(facts["seed"][0], facts["outcome"][0], heading, facts["steps"][0], chosen, pictures)
