"""Results of an unfinished evaluation, saved episode by episode: the same command plays only the missing ones."""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from vla.io.documents import parse_json, read_bounded
from vla.io.files import try_lock, write_text, writing
from vla.rollouts.results import Result

LOCK = ".evaluation"  # held by the process that evaluates into a run's folder
RESULTS_FILE = "played.jsonl"  # exists in a run's folder while an evaluation has no report yet
MAX_BYTES = 4 << 30  # of that file [bytes], millions of episodes

log = logging.getLogger(__name__)

Episode = tuple[str, Result]  # condition with what determines its results, result


class PlayedEpisodes(AbstractContextManager["PlayedEpisodes"]):
    """Results so far, in a file that is removed at the end of this context, but stays after an error."""

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        """Continue the file in a run's folder if its first line is `head`, which determines the episodes, or begin it.

        Raises an OSError if it cannot be written, and a UserError if another process evaluates in the folder.
        """
        folder.mkdir(parents=True, exist_ok=True)
        busy = f"another process evaluates in {folder}: wait for it, or choose another output=DIR"
        self._lock = try_lock(folder / LOCK, busy)
        self._path, lines = folder / RESULTS_FILE, [_line(head)]
        self.results = defaultdict[str, dict[int, Result]](dict)  # condition → seed → result
        text = read_bounded(self._path, MAX_BYTES).decode("utf-8", "replace") if self._path.is_file() else ""
        if text.startswith(lines[0]):
            for line in text.split("\n")[1:]:
                try:
                    condition, result = parse_json(line, cast(type[Episode], Episode), str(self._path))
                except ValueError:  # the process was killed while it wrote this line, or the file ends
                    break
                self.results[condition][result.seed] = result
                lines.append(f"{line}\n")
            if count := len(lines) - 1:
                log.info("episodes already played: %d, in %s", count, self._path)
        write_text(self._path, "".join(lines))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Remove the file, unless an error leaves results to continue with, and release the lock."""
        if kind is None or not any(self.results.values()):
            self._path.unlink(missing_ok=True)
        Path(self._lock.lock_file).unlink(missing_ok=True)  # while it is held: a later process creates a new one
        self._lock.release()

    def add(self, condition: str, result: Result) -> None:
        """Write the result of another episode; raise an OSError if the file cannot be written."""
        with writing(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(_line((condition, asdict(result))))
        self.results[condition][result.seed] = result


def _line(content: Any) -> str:
    return json.dumps(content, allow_nan=False) + "\n"
