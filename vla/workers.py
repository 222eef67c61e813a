"""What collection and evaluation share about the processes they start."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process

# Mesa's renderer counts the threads beside the one that calls it.
THREAD_SETTINGS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def leave_with_parent() -> None:
    """End this worker process as soon as the process that started it has ended, however it did."""

    def wait() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)  # nobody is left to work for

    threading.Thread(target=wait, daemon=True).start()


def one_thread() -> None:
    """Numerical libraries use one thread from now on: sums must not depend on how many workers share the machine."""
    os.environ.update(THREAD_SETTINGS)  # read by libraries that are loaded from now on
    if torch := sys.modules.get("torch"):  # loaded already where this process trained the policy
        torch.set_num_threads(1)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Within, this process and those that it starts keep to `one_thread`."""
    before = {name: os.environ.get(name) for name in THREAD_SETTINGS}
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch else 0
    one_thread()
    try:
        yield
    finally:
        if torch:
            torch.set_num_threads(threads)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
