"""Recordings as text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vla.spec import Array, Environment, Episode, Observation


class Lines:
    """Writes a file per episode, `SEED.jsonl`: the action of each step on a line, then the outcome.

    Args:
        digits: of the numbers, after the point.
        folder: to write to.
    """

    def __init__(self, digits: int, *, folder: Path) -> None:
        self._digits, self._folder = digits, folder
        self._lines: list[Any] = []

    def start(self, environment: Environment) -> None:
        """Begin an episode."""
        self._lines = []

    def step(self, observation: Observation, action: Array, info: Mapping[str, Any]) -> None:
        """Add an action."""
        self._lines.append(action.astype(float).round(self._digits).tolist())

    def end(self, episode: Episode) -> None:
        """Write the file."""
        self._folder.mkdir(parents=True, exist_ok=True)
        lines = [json.dumps(line) for line in [*self._lines, episode.outcome]]
        (self._folder / f"{episode.seed}.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
