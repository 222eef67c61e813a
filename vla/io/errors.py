"""The error of whatever a user can mend."""

from __future__ import annotations


class UserError(ValueError):
    """Something that the user can mend: a value, a file or the machine. Its text names the thing and the way out.

    The entry point prints the text alone. Every other exception is a bug and keeps its traceback.
    """
