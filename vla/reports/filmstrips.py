"""Filmstrips of recorded rollouts: a few frames of an episode from every camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader, StoreEntry

MOMENTS = 8  # frames of a filmstrip
PROPERTIES, INSTRUCTION, CAMERAS = "/__properties/episode", "/instruction", "/camera/**"
EVENTS = "/events"


@dataclass(frozen=True)
class Filmstrip:
    """A few frames of an episode."""

    seed: int
    outcome: str
    instruction: str
    length: int  # of the episode [steps]
    steps: list[int]  # of the frames
    pictures: dict[str, list[bytes]]  # camera → one JPEG per step
    events: list[tuple[int, str]]  # step and description of what happened without the agent


def read_filmstrips(file: Path, failures: int, successes: int) -> list[Filmstrip]:
    """Read filmstrips from a recording of `vla.rollouts.recorder`, failures before successes.

    The failures cycle through the outcomes, so that each outcome is included before one repeats.

    Args:
        file: the recording.
        failures: maximum number of failed episodes.
        successes: maximum number of successful episodes.

    Raises:
        ValueError: the file cannot be read.
    """
    try:
        reader = RrdReader(file)
        return [_strip(reader, entry) for entry in _chosen(reader.recordings(), failures, successes)]
    except (RuntimeError, KeyError, ValueError) as error:  # damaged, or a recording of another program
        raise ValueError(f"{file} cannot be read: remove it to write the page without pictures: {error}") from error


def _chosen(entries: Sequence[StoreEntry], failures: int, successes: int) -> list[StoreEntry]:
    failed, succeeded = [], []
    counts: Counter[str] = Counter()
    for entry in sorted(entries, key=lambda entry: entry.recording_id):
        kind, _, *outcome = entry.recording_id.split("-")[:-1]  # see `vla.rollouts.recorder.recording_name`
        if kind == "success":
            succeeded.append(entry)
        else:
            failed.append((counts["-".join(outcome)], entry))
            counts["-".join(outcome)] += 1
    failed.sort(key=lambda one: one[0])
    return [*(entry for _, entry in failed[:failures]), *succeeded[:successes]]


def _strip(reader: RrdReader, entry: StoreEntry) -> Filmstrip:
    properties: dict[str, Any] = {}
    texts: dict[int, str] = {}  # step → text from there on
    frames: dict[str, dict[int, Any]] = {}  # camera → step → blob
    events: list[tuple[int, str]] = []
    content = [PROPERTIES, INSTRUCTION, CAMERAS, EVENTS]
    for chunk in reader.store(store=entry).stream().filter(content=content).to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path.startswith("/camera/"):
            _, _, camera, kind = chunk.entity_path.split("/")
            if kind == "rgb":
                blobs = zip(batch.column("step").to_pylist(), batch.column("EncodedImage:blob"), strict=True)
                frames.setdefault(camera, {}).update(blobs)
        elif chunk.entity_path == EVENTS:
            told = [text for (text,) in batch.column("TextLog:text").to_pylist()]
            events += zip(batch.column("step").to_pylist(), told, strict=True)
        elif chunk.entity_path == INSTRUCTION:
            columns = batch.to_pydict()
            texts.update(zip(columns.get("step", [0]), (text for [text] in columns["TextDocument:text"]), strict=True))
        else:
            properties.update({name: values[0] for name, values in batch.to_pydict().items()})
    steps: list[int] = sorted(next(iter(frames.values()), {}))
    places = np.linspace(0, len(steps) - 1, min(MOMENTS, len(steps))).round().astype(int)
    chosen = [steps[int(place)] for place in places]
    pictures = {camera: [bytes(at[step][0].as_py()) for step in chosen] for camera, at in frames.items()}
    headings = [texts[step].partition("\n")[0].removeprefix("### ") for step in sorted(texts)]
    heading = "; then ".join(headings)
    seed, outcome, length = (properties[name][0] for name in ("seed", "outcome", "steps"))
    return Filmstrip(seed, outcome, heading, length, chosen, pictures, sorted(events))
