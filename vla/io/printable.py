"""Texts of others on a terminal, where control characters could move the cursor, set the title or hide lines."""

from __future__ import annotations

import logging
import re
from typing import Any

# Control characters but for tab and line feed, marks of writing direction, line separators, and halves of a character.
HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""Return a text with hidden characters as escapes, such as \x1b."""
    return HIDDEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class Formatter(logging.Formatter):
    """Formatter of logs whose texts may come from files and networks."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record, as `printable` text."""
        return printable(super().format(record))


def show(renderable: Any) -> None:
    """Print a table, or a text with rich's markup; all texts in it are `printable`."""
    from rich import get_console  # takes a while, and sentences need none of it
    from rich.segment import Segment, Segments

    console = get_console()
    parts = [each if each.control else Segment(printable(each.text), each.style) for each in console.render(renderable)]
    console.print(Segments(parts), end="")
