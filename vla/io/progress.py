"""How far a long work is: a bar on a terminal, and a line now and then in a file or a pipe."""

from __future__ import annotations

import logging
import time
from datetime import timedelta

from rich import get_console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

log = logging.getLogger(__name__)

EVERY = 60.0  # between two lines [s]


class Lines:
    """Logs how far a work is where no bar is painted before its end: in a job of a cluster, or under nohup."""

    def __init__(self) -> None:
        self._said = time.monotonic()

    def are_due(self) -> bool:
        """Return whether there is neither a terminal nor a recent line."""
        return time.monotonic() - self._said >= EVERY and not get_console().is_terminal

    def say(self, label: str, done: int, total: float, note: str, left: float | None) -> None:
        """Log `done` of `total`, a note, and the time that is left [s] if it is known."""
        self._said = time.monotonic()
        time_left = "" if left is None else f"{timedelta(seconds=round(left))} left"
        of = f" of {total:.0f}" if total < float("inf") else ""
        log.info("%s", ", ".join(filter(None, (f"{label}: {done}{of}", note, time_left))))


class Bar(Progress):
    """Progress of episodes, with a label before the bar and a note behind it."""

    def __init__(self, label: str, total: int, done: int = 0, note: str = "") -> None:
        columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
        super().__init__(*columns, TimeRemainingColumn())
        self._label, self._lines = label, Lines()
        self.add_task(note, total=total, completed=done)

    def show(self, done: int, note: str = "") -> None:
        """Show that so many are done."""
        (task,) = self.tasks
        self.update(task.id, completed=done, description=note)
        if self._lines.are_due():
            self._lines.say(self._label, done, task.total or 0, note, task.time_remaining)
