"""Results of an unfinished evaluation, written episode by episode, so that an interrupted evaluation continues."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from vla.config.differences import differences
from vla.io.documents import STRICT, parse_json, read_bounded
from vla.io.files import write_text, writing
from vla.rollouts.results import Result

PLAYED = "played.jsonl"  # exists in a run's folder while an evaluation has no report yet
LARGEST = 4 << 30  # of that file [bytes], millions of episodes

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Evaluation:
    """First line of the file: the inputs that determine the episodes."""

    __pydantic_config__ = STRICT

    changed_ns: dict[str, int | None]  # file or folder of the policy → time of its last change; None: there is none
    config: dict[str, Any]
    versions: dict[str, str]

    def continues(self, other: _Evaluation) -> bool:
        """Return whether both play the same episodes."""
        mine, theirs = ((each.changed_ns, each.versions) for each in (self, other))
        return mine == theirs and not differences(self.config, other.config)


@dataclass(frozen=True)
class _Episode:
    """Any other line."""

    __pydantic_config__ = STRICT

    condition: str
    seconds: float  # of the evaluation so far [s]
    result: Result


class Played:
    """Results that an evaluation has so far, as a context manager which removes their file at the end.

    If the evaluation is interrupted, or its report cannot be written, the file stays; the same evaluation in the same
    folder then starts with its results.
    """

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
        evaluation = _Evaluation({str(path): _changed_ns(path) for path in sources}, dict(config), versions)
        self._path = folder / PLAYED
        episodes = _read(self._path, evaluation)
        self._started = time.monotonic() - max((each.seconds for each in episodes), default=0.0)
        self._results: dict[str, dict[int, Result]] = {}
        for each in episodes:
            self.of(each.condition)[each.result.seed] = each.result
        if episodes:
            log.info("%s: already played, %d in all", self._path, len(self))
        write_text(self._path, "".join(map(_line, (evaluation, *episodes))))

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
            log.info(
                "%s keeps what was played, %d in all: the same command with output=%s continues",
                self._path,
                len(self),
                self._path.parent,
            )

    def __len__(self) -> int:
        """Return the number of results under all conditions."""
        return sum(map(len, self._results.values()))

    @property
    def seconds(self) -> float:
        """Duration of the evaluation so far, without interruptions [s]."""
        return time.monotonic() - self._started

    def of(self, condition: str) -> dict[int, Result]:
        """Return seed → result of the episodes played under a condition."""
        return self._results.setdefault(condition, {})

    def add(self, condition: str, result: Result) -> None:
        """Write the result of another episode.

        Raises:
            OSError: the file cannot be written.
        """
        with writing(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(_line(_Episode(condition, self.seconds, result)))
        self.of(condition)[result.seed] = result


def _changed_ns(path: Path) -> int | None:
    """Return the time of the last change of a file, or of any file in a folder; None if there is none."""
    files = [path, *path.rglob("*")] if path.is_dir() else [path]
    return max((file.stat().st_mtime_ns for file in files if file.exists()), default=None)


def _line(content: _Evaluation | _Episode) -> str:
    return json.dumps(asdict(content), allow_nan=False, ensure_ascii=False) + "\n"


def _read(path: Path, evaluation: _Evaluation) -> list[_Episode]:
    """Return the episodes in a file, up to the first damaged line, if they are of this evaluation."""
    if not path.is_file():
        return []
    head, *lines = read_bounded(path, LARGEST).splitlines() or [b""]
    found = list[_Episode]()
    try:
        if not parse_json(head, _Evaluation, str(path)).continues(evaluation):
            log.info("%s is of another evaluation, which this one replaces", path)
            return []
        for line in lines:
            found.append(parse_json(line, _Episode, str(path)))
    except ValueError as error:  # a process that was killed while it wrote
        log.warning("%s; the episodes from there on are played again", error)
    return found
