"""Progress of long work: a bar on a terminal, and an occasional line in a file or a pipe."""

from __future__ import annotations

import logging
import time
from datetime import timedelta

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

log = logging.getLogger(__name__)

LOG_INTERVAL = 60.0  # between two lines [s]
SPEED_PERIOD = 600.0  # over which the remaining time is estimated: single episodes may take a minute [s]


class Bar(Progress):
    """A bar with a label before it and a note behind it.

    Where the bar is only drawn at its end, in a job of a cluster or under nohup, lines are logged as well.
    """

    def __init__(self, label: str, total: int | None, done: int = 0, note: str = "") -> None:
        """Without a `total` the work has no known end."""
        count = MofNCompleteColumn(table_column=Column(no_wrap=True))  # so only the bar gives way to a long note
        columns = (TextColumn(label), BarColumn(bar_width=None), count, TextColumn("{task.description}"))
        # Painting takes milliseconds, in a thread that the work waits for.
        super().__init__(*columns, TimeRemainingColumn(), refresh_per_second=4, speed_estimate_period=SPEED_PERIOD)
        self._label, self._logged_at = label, time.monotonic()
        self.add_task(note, total=total, completed=done)

    def show(self, done: int, note: str = "") -> None:
        """Show that `done` items are completed, with a note."""
        (task,) = self.tasks
        self.update(task.id, completed=done, description=note)
        if time.monotonic() - self._logged_at >= LOG_INTERVAL and not self.console.is_terminal:
            self._logged_at, seconds_left = time.monotonic(), task.time_remaining
            total = "" if task.total is None else f" of {task.total:.0f}"
            time_left = "" if seconds_left is None else f"{timedelta(seconds=round(seconds_left))} left"
            log.info("%s", ", ".join(filter(None, (f"{self._label}: {done}{total}", note, time_left))))
