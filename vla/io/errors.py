"""The error for everything that a user can fix, and words of messages: counts, and suggestions for a misspelt name."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(ValueError):
    """Something that the user can fix: a value, a file or the machine. Its text names the thing and the way out.

    The entry point prints the text alone. Every other exception is a bug and keeps its traceback.
    """


def counted(number: int, noun: str) -> str:
    """Return a number and its noun, which is in the plural unless the number is 1."""
    return f"{number} {noun}{'' if number == 1 else 'es' if noun.endswith(('s', 'ch')) else 's'}"


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return `, did you mean …?`, or an empty string without a similar name."""
    matches = get_close_matches(name, list(names), n=1)
    return f", did you mean {matches[0]}?" if matches else ""
