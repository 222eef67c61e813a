"""`index.html` in a folder of runs, the list of their pages.

The head of every page says what the list needs, so that no report is read to write it.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from html import unescape
from pathlib import Path
from urllib.parse import quote

from filelock import FileLock

from vla.io.documents import parse_json
from vla.io.errors import UserError
from vla.reports.page import render
from vla.reports.tables import Table, links
from vla.runs.folder import PAGE

log = logging.getLogger(__name__)

RUNS, INDEX, LOCK = "runs", "index.html", ".index.lock"
HEAD = 1 << 14  # [bytes] of a page, within which its entry is
HEADS = ("run", "written", "policy", "task", "success [%]", "episodes", "training")


def entry(policy: str, task: str, success: str, episodes: str, training: str) -> str:
    """Return what a list says of a run whose page is written now, for the head of that page."""
    return json.dumps([datetime.now().isoformat(" "), policy, task, success, episodes, training])


def write_index(runs: Path) -> Path:
    """List the runs in a folder that have a page, the newest first, and return the path of the list.

    Of processes that do so at once the last one lists the pages of all.
    """
    with FileLock(runs / LOCK):
        listed = sorted(_entries(runs), key=lambda run: run[1][0], reverse=True)
        rows = [[links({name: f"{quote(name)}/{PAGE}"}), told[0][:16], *told[1:]] for name, told in listed]
        return render(runs / INDEX, f"{len(rows)} run{'s' * (len(rows) != 1)}", [Table(HEADS, rows)])


def _entries(runs: Path) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield name and entry of every run; pages of other programs have none."""
    for page in filter(Path.is_file, runs.glob(f"*/{PAGE}")):
        with page.open("rb") as file:
            head = file.read(HEAD).decode("utf-8", "replace")
        if found := re.search(r'<meta name="vla-run" content="([^"]*)">', head):
            try:
                yield page.parent.name, parse_json(unescape(found[1]), tuple[str, str, str, str, str, str], str(page))
            except UserError as error:
                log.warning("%s is not listed: %s", page, error)
