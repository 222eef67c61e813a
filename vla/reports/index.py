"""`index.html` in a folder of runs, the list of their pages.

The head of every page says what the list needs, so that no report is read to write it.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from datetime import datetime
from html import unescape
from pathlib import Path
from urllib.parse import quote

from filelock import FileLock

from vla.config.differences import ABSENT
from vla.io.documents import STRICT, parse_json
from vla.reports.html import PageTable, links, rate, render
from vla.runs.folder import PAGE

log = logging.getLogger(__name__)

RUNS, INDEX, LOCK = "runs", "index.html", ".index.lock"
HEAD = 1 << 14  # [bytes] of a page, within which its entry is


@dataclass(frozen=True)
class Entry:
    """What a list says of a run."""

    __pydantic_config__ = STRICT

    policy: str
    task: str
    success: tuple[float, float, float] | None  # rate and its interval
    episodes: int | None
    remark: str  # interrupted, failed, or empty
    written: str = field(default_factory=lambda: datetime.now().isoformat(" ", "milliseconds"))

    def to_json(self) -> str:
        """Return the entry for the head of a page."""
        return json.dumps(asdict(self), ensure_ascii=False)


def write_index(runs: Path) -> Path:
    """List the runs in a folder that have a page, the newest first, and return the path of the list.

    Of processes that do so at once the last one lists the pages of all.
    """
    with FileLock(runs / LOCK):
        listed = sorted(_entries(runs), key=lambda run: run[1].written, reverse=True)
        rows = [
            [
                links({name: f"{quote(name)}/{PAGE}"}),
                entry.written[:16],
                entry.policy or ABSENT,
                entry.task or ABSENT,
                rate(entry.success) if entry.success else ABSENT,
                ABSENT if entry.episodes is None else str(entry.episodes),
                entry.remark,
            ]
            for name, entry in listed
        ]
        heads = ("run", "written", "policy", "task", "success [%]", "episodes", "training")
        count = f"{len(rows)} run{'s' * (len(rows) != 1)}"
        return render(runs / INDEX, "index.html", title=count, table=PageTable(heads, rows))


def _entries(runs: Path) -> Iterator[tuple[str, Entry]]:
    """Yield name and entry of every run; pages of other programs have none."""
    for page in runs.glob(f"*/{PAGE}"):
        if not page.is_file():
            continue
        with page.open("rb") as file:
            head = file.read(HEAD).decode("utf-8", "replace")
        if found := re.search(r'<meta name="vla-run" content="([^"]*)">', head):
            try:
                yield page.parent.name, parse_json(unescape(found[1]), Entry, str(page))
            except ValueError as error:
                log.warning("%s is not listed: %s", page, error)
