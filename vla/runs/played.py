"""Results of an evaluation as they are played; what an interrupted one left is not played again."""

from __future__ import annotations

import json
import logging
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, cast

from vla.config.differences import differences
from vla.io.documents import parse_json, read_bounded
from vla.io.files import write_text, writing
from vla.rollouts.results import Result

PLAYED = "played.jsonl"  # exists in a run's folder while an evaluation has no report yet
LARGEST = 4 << 30  # of that file [bytes], millions of episodes

log = logging.getLogger(__name__)

Episode = tuple[str, float, Result]  # condition, duration of the evaluation so far [s], result


class Played:
    """Results so far, in a file that is removed at the end of this context, but stays after an error."""

    def __init__(
        self, folder: Path, sources: Sequence[Path], config: Mapping[str, Any], versions: dict[str, str]
    ) -> None:
        """Read the results of the same evaluation, if an earlier one left any, and start the file.

        Args:
            folder: of the run.
            sources: files and folders that the policy or agent is read from.
            config: the resolved config.
            versions: library → version.

        Raises:
            OSError: the file cannot be written.
        """
        self._path = folder / PLAYED
        # First line of the file: what determines the episodes.
        head = {"changed_ns": {str(path): _changed_ns(path) for path in sources}, "versions": versions}
        episodes = self._read(head, config)
        self._started = time.monotonic() - max((seconds for _, seconds, _ in episodes), default=0.0)
        self._results = defaultdict[str, dict[int, Result]](dict)
        for condition, _, result in episodes:
            self._results[condition][result.seed] = result
        if episodes:
            log.info("%s: already played, %d in all", self._path, len(self))
        lines = [(condition, seconds, asdict(result)) for condition, seconds, result in episodes]
        write_text(self._path, "".join(map(_line, ({**head, "config": config}, *lines))))

    def _read(self, head: Mapping[str, Any], config: Mapping[str, Any]) -> list[Episode]:
        """Return the episodes in the file, up to the first damaged line, if they are of this evaluation."""
        if not self._path.is_file():
            return []
        first, *lines = read_bounded(self._path, LARGEST).splitlines() or [b""]
        found = list[Episode]()
        try:
            saved = parse_json(first, dict[str, Any], str(self._path))
            if differences(saved.pop("config", {}), config) or saved != head:
                log.info("%s is of another evaluation, which this one replaces", self._path)
                return []
            found.extend(parse_json(line, cast(type[Episode], Episode), str(self._path)) for line in lines)
        except ValueError as error:  # a process that was killed while it wrote
            log.warning("%s; the episodes from there on are played again", error)
        return found

    def __enter__(self) -> Played:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the file, or say where the results are."""
        if kind is None or not len(self):
            self._path.unlink(missing_ok=True)
        else:
            again = "%s keeps what was played, %d in all: the same command with output=%s continues"
            log.info(again, self._path, len(self), self._path.parent)

    def __len__(self) -> int:
        """Return the number of results under all conditions."""
        return sum(map(len, self._results.values()))

    @property
    def seconds(self) -> float:
        """Duration of the evaluation so far, without interruptions [s]."""
        return time.monotonic() - self._started

    def of(self, condition: str) -> dict[int, Result]:
        """Return seed → result of the episodes played under a condition."""
        return self._results[condition]

    def add(self, condition: str, result: Result) -> None:
        """Write the result of another episode; an OSError if the file cannot be written."""
        with writing(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(_line((condition, self.seconds, asdict(result))))
        self._results[condition][result.seed] = result


def _changed_ns(path: Path) -> int | None:
    """Return the time of the last change of a file, or of any file in a folder; None if there is none."""
    files = [path, *path.rglob("*")] if path.is_dir() else [path]
    return max((file.stat().st_mtime_ns for file in files if file.exists()), default=None)


def _line(content: Any) -> str:
    return json.dumps(content, allow_nan=False, ensure_ascii=False) + "\n"
