"""How a program ends: without the freeing of all that it imported, which would take up to two seconds."""

from __future__ import annotations

import atexit
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_around = False


@contextmanager
def swift_end() -> Iterator[None]:
    """Around all that a program does: what it starts and registers ends as ever, and the process as soon as it has.

    Of what was registered before, which would come after it, only `logging` ends; so this goes around the imports that
    a program makes as it needs them. Around another one, the inner does nothing.
    """
    global _around
    if _around:
        yield
        return
    _around, status = True, 1

    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started the program, so that the next file would take its place
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
