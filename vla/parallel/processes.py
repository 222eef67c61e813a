"""Worker processes of this machine: start, communication, threads and end."""

from __future__ import annotations

import atexit
import gc
import logging
import os
import pickle
import resource
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

GPUS = "nvidiactl", "dxg", "kfd"  # devices of NVIDIA, the same in WSL, and of AMD
SECONDS_TO_END = 5.0  # [s] for an idle process to free its resources
MANY_FILES = 8192  # open files for a thousand workers, each of which takes six if they share a policy
WORKER = "VLA_WORKER"  # environment variable: number of a worker process in its pool

# LP_NUM_THREADS is read by Mesa's renderer, which does not count the calling thread.
THREAD_SETTINGS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}


class Worker(Protocol):
    """Sequential processor of items."""

    def attempt(self, item: Any, /) -> Any:
        """Return the result of one item."""

    def close(self) -> None:
        """Free the resources of the worker."""


WorkerFactory = Callable[[], Worker]


class ProcessEnded(Exception):
    """Crash or kill of a worker process; the message is its exit status or signal."""


class WorkerProcess:
    """Spawned process that sends one answer when its worker exists, and then one per item."""

    def __init__(self, make: bytes, number: int) -> None:
        self._connection, child_end = get_context("spawn").Pipe()
        # A daemon ends with this process, even if the context of its pool is never left.
        self._process = get_context("spawn").Process(target=_serve, args=(child_end, make, number), daemon=True)
        self._process.start()
        child_end.close()  # so that the end of the process ends the connection

    @property
    def killed(self) -> bool:
        """True if a signal ended the process."""
        return (self._process.exitcode or 0) < 0

    def ask(self, item: Any) -> Any:
        """Return the result of an item; raises the error of the attempt, or `ProcessEnded` if the process ended."""
        try:
            self._connection.send(item)
        except OSError as error:
            raise ProcessEnded(self._exit_reason()) from error
        return self.answer()

    def answer(self) -> Any:
        """Receive the next answer; raises as `ask` does."""
        try:
            result, error = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as end:
            raise ProcessEnded(self._exit_reason()) from end
        if error is not None:
            raise error
        return result

    def _exit_reason(self) -> str:
        self._process.join()
        code = self._process.exitcode or 0
        if code >= 0:
            return f"it ended with exit status {code}"
        memory = ", perhaps because memory ran out" if code == -signal.SIGKILL else ""
        return f"it was ended by signal {-code} ({signal.strsignal(-code)}{memory})"

    def dismiss(self) -> None:
        """Close the connection: the process ends as soon as it is idle."""
        self._connection.close()

    def join(self) -> None:
        """Wait up to `SECONDS_TO_END` for the end of the process."""
        self._process.join(SECONDS_TO_END)

    def release(self) -> None:
        """Close the files of a process that has ended."""
        self._connection.close()
        self._process.close()

    def kill(self) -> None:
        """End the process at once, if it has not ended."""
        self._process.kill()
        self._process.join()


def _serve(connection: Connection, make: bytes, number: int) -> None:
    """Create a worker and process items until the connection is closed."""
    os.environ[WORKER] = str(number)
    leave_with_parent()
    workers: list[Worker] = []
    # Unpickled here, not as an argument of the process, so that import errors reach the parent.
    connection.send_bytes(_outcome(lambda: workers.append(pickle.loads(make)())))
    for worker in workers:
        with closing(worker):
            while True:
                try:
                    item = connection.recv()
                except EOFError:
                    return
                connection.send_bytes(_outcome(worker.attempt, item))


def _outcome(function: Callable[..., Any], *arguments: Any) -> bytes:
    """Call a function; return (result, error) pickled, with the traceback as a note on the error."""
    try:
        return pickle.dumps((function(*arguments), None))
    except Exception as error:  # any error, also of pickling: the parent raises it
        portable_error = make_picklable(error)
        portable_error.add_note(f"\nIn the worker process:\n{traceback.format_exc()}")
        return pickle.dumps((None, portable_error))


def make_picklable(error: BaseException) -> BaseException:
    """Return the error, or a RuntimeError with its text if it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # its constructor may fail in any way
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def leave_with_parent() -> None:
    """End this worker process as soon as its parent has ended in any way."""

    def wait() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def ease_garbage_collection() -> None:
    """Make the cyclic garbage collector run rarely, and not at the exit of the program.

    Its passes during imports take a second and free little. Those at exit take up to two, and the process ends anyway.
    """
    gc.set_threshold(50_000, 20, 100)
    atexit.register(gc.freeze)


def spin_briefly() -> None:
    """Make OpenMP threads spin only briefly before they sleep. Call this before PyTorch is imported.

    By default they spin for about a millisecond. If another process, such as a second training, uses the same cores,
    spinning threads take these cores from the very threads that they wait for, in every operation.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # about ten microseconds


def allow_many_files() -> None:
    """Raise the limit of open files, usually 1024, to `MANY_FILES` or as far as the system permits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MANY_FILES if hard == resource.RLIM_INFINITY else min(MANY_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # a system may permit less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


@contextmanager
def signal_event(*signals: signal.Signals) -> Iterator[threading.Event]:
    """Yield an event that these signals set within the context."""
    event = threading.Event()
    handlers = {number: signal.signal(number, lambda *_: event.set()) for number in signals}
    try:
        yield event
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def without_triton() -> None:
    """Block the import of Triton where PyTorch cannot use it, on machines without a GPU.

    Triton and Mesa's software renderer each contain an LLVM, and processes that load Mesa's first crash. Call this
    before Lightning is imported, which imports Triton.
    """
    if not any(Path("/dev", name).exists() for name in GPUS):
        sys.modules.setdefault("triton", None)  # type: ignore[arg-type]
        for name in ("flop_counter", "cpp_extension"):  # they warn without Triton, and without a GPU
            logging.getLogger(f"torch.utils.{name}").setLevel(logging.ERROR)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Limit numerical libraries of this process and its children to one thread within the context.

    Sums must not depend on the number of workers on the machine.
    """
    old_values = {name: os.environ.get(name) for name in THREAD_SETTINGS}
    torch = sys.modules.get("torch")  # already loaded if this process trained the policy
    threads = torch.get_num_threads() if torch else 0
    os.environ.update(THREAD_SETTINGS)  # read when a library is loaded
    if torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if torch:
            torch.set_num_threads(threads)
        for name, value in old_values.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
