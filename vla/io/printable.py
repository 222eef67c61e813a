"""Untrusted texts on a terminal, where control characters could move the cursor, set the title or hide lines."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable
from typing import Any, TypeVar

Item = TypeVar("Item")

# Control characters but for tab and line feed, marks of writing direction, line separators, and halves of a character.
HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def escape(text: str) -> str:
    r"""Return a text with hidden characters as escapes, such as \x1b."""
    return HIDDEN.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


class Formatter(logging.Formatter):
    """Formatter of logs whose texts may come from files and networks."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record, without hidden characters."""
        return escape(super().format(record))


def display_unit(unit: str) -> tuple[float, str]:
    """Return the factor from the unit of an action to the one for display, and that unit; "" for none."""
    return {"m": (1000.0, "mm"), "rad": (180 / math.pi, "deg"), "1": (1.0, "")}.get(unit, (1.0, unit))


def show(renderable: Any) -> None:
    """Print a table, or a text with rich's markup; hidden characters in its texts are escaped."""
    from rich import get_console  # takes a while, and sentences need none of it
    from rich.segment import Segment, Segments

    console = get_console()
    parts = [part if part.control else Segment(escape(part.text), part.style) for part in console.render(renderable)]
    console.print(Segments(parts), end="")


def track(items: Iterable[Item], description: str, total: float | None = None) -> Iterable[Item]:
    """Show a progress bar of an iteration.

    The bar is drawn in this thread: one of its own may deadlock if an abandoned iterator is garbage-collected in it.
    """
    from rich import progress

    return progress.track(items, description, total, auto_refresh=False)
