"""Program exit without interpreter teardown, which would take up to two seconds."""

from __future__ import annotations

import atexit
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_active = False


@contextmanager
def fast_exit() -> Iterator[None]:
    """Run the program; then run its exit handlers and exit at once, skipping interpreter teardown.

    Of the exit handlers registered before, which would run last, only that of `logging` runs: enter this context before
    lazy imports. A nested context does nothing.
    """
    global _active
    if _active:
        yield
        return
    _active, status = True, 1

    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller: the next opened file would take its descriptor
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 for the rest of the program

    def end() -> None:
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)

    atexit.register(end)
    try:
        yield
        status = 0
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        raise
