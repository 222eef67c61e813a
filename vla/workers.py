"""Worker processes of this machine, which collection, evaluation and exports share."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, Protocol

log = logging.getLogger(__name__)

PATIENCE = 5.0  # [s] for an idle process to free what it holds

# Mesa's renderer counts the threads beside the one that calls it.
THREAD_SETTINGS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}


class Worker(Protocol):
    """What turns items into results, one after the other."""

    def attempt(self, item: Any, /) -> Any:
        """What becomes of one item."""
        ...

    def close(self) -> None:
        """Free what the worker holds."""
        ...


MakeWorker = Callable[[], Worker]


class WorkersLost(ValueError):
    """Worker processes crashed, were killed or went out of reach; new ones may fare better."""


class Pool:
    """Spawned processes that each make one worker and keep it; a GL context would not survive a fork.

    Every process belongs to one thread of this process, which sends it items and waits for the results. When a process
    crashes, another one attempts the same item once more: in long runs processes were seen to crash outside Python.
    Ctrl-C is handled by this process alone: leaving the context by an exception kills the others at once.
    """

    def __init__(self, make: MakeWorker, processes: int, key: str) -> None:
        """`key` is the name under which the user sets `processes`, for messages."""
        self._make, self._key = pickle.dumps(make), key
        self._lock = threading.Lock()
        self._processes: list[_Process] = []
        self._closed = False
        self._own = threading.local()
        self._threads = ThreadPoolExecutor(processes, initializer=self._enter_thread)

    def submit(self, item: Any) -> Future[Any]:
        """Attempt an item as soon as a process is idle.

        The future raises what making the worker or the attempt raised, `WorkersLost` with the cause if the process
        crashed twice, or a ValueError if it crashed before it had made its worker.
        """
        return self._threads.submit(self._attempt, item)

    def __enter__(self) -> Pool:
        """Nothing is started before it is needed."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all processes: idle ones when the context was left normally."""
        with _interrupts_held(again=kind is None):
            with self._lock:
                self._closed = True
            for process in self._processes if kind else ():
                process.kill()
            self._threads.shutdown(cancel_futures=True)
            for process in self._processes:
                process.dismiss()
            for process in self._processes:
                process.join()

    def _enter_thread(self) -> None:
        # What a thread blocks is blocked in the processes that it starts; starting the tracker would unblock it.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._own.process = None

    def _attempt(self, item: Any) -> Any:
        try:
            return self._process().ask(item)
        except WorkersLost as lost:
            if self._closed:
                raise
            log.warning("a worker process crashed (%s); trying again", lost)
        self._own.process = None
        try:
            return self._process().ask(item)
        except WorkersLost:
            self._own.process = None
            raise

    def _process(self) -> _Process:
        """The process of this thread, which has made its worker."""
        if self._own.process is None:
            with self._lock:
                if self._closed:
                    raise WorkersLost("nothing is attempted any more")
                process = _Process(self._make)
                self._processes.append(process)
            try:
                process.answer()
            except WorkersLost as lost:
                if process.killed:
                    raise
                raise ValueError(
                    f"a worker process could not start: {lost}, see what it printed, or run with {self._key}=1"
                ) from lost
            self._own.process = process
        own: _Process = self._own.process
        return own


class _Process:
    """A spawned process, which answers once when it has made its worker, and then to every item."""

    def __init__(self, make: bytes) -> None:
        self._connection, there = get_context("spawn").Pipe()
        # A daemon is ended with this process, even if its pool is never left.
        self._process = get_context("spawn").Process(target=_serve, args=(there, make), daemon=True)
        self._process.start()
        there.close()  # so that the end of the process ends the connection

    @property
    def killed(self) -> bool:
        """Whether a signal ended it."""
        return (self._process.exitcode or 0) < 0

    def ask(self, item: Any) -> Any:
        """The result of an item; raises what the attempt raised, and `WorkersLost` if the process ended."""
        try:
            self._connection.send(item)
        except OSError as error:
            raise WorkersLost(self._how_it_ended()) from error
        return self.answer()

    def answer(self) -> Any:
        """The next answer; raises as `ask` does."""
        try:
            result, error, remote = self._connection.recv()
        except (EOFError, OSError) as end:
            raise WorkersLost(self._how_it_ended()) from end
        if error is not None:
            raise error from _RemoteTraceback(remote)
        return result

    def _how_it_ended(self) -> str:
        self._process.join()
        code = self._process.exitcode or 0
        if code >= 0:
            return f"it ended with exit status {code}"
        memory = ", perhaps because memory ran out" if code == -signal.SIGKILL else ""
        return f"it was ended by signal {-code} ({signal.strsignal(-code)}{memory})"

    def kill(self) -> None:
        """End it in the middle of whatever it does."""
        self._process.kill()

    def dismiss(self) -> None:
        """Let it end by itself, as soon as it is idle."""
        self._connection.close()

    def join(self) -> None:
        """Wait until it has ended, not too long."""
        self._process.join(PATIENCE)
        self._process.kill()
        self._process.join()


class _RemoteTraceback(Exception):
    """The traceback of another process, as text."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __str__(self) -> str:
        return f"\n{self._text}"


def _serve(connection: Connection, make: bytes) -> None:
    """Make a worker and answer to every item that comes, until the connection ends."""
    leave_with_parent()
    made: list[Worker] = []
    # Unpickled here, and not as an argument of the process: only so do the errors of imports reach the parent.
    connection.send(_outcome(lambda: made.append(pickle.loads(make)())))
    for worker in made:
        with closing(worker):
            while True:
                try:
                    item = connection.recv()
                except EOFError:
                    return
                connection.send(_outcome(worker.attempt, item))


def _outcome(function: Callable[..., Any], *arguments: Any) -> tuple[Any, Exception | None, str]:
    """What a function returned, what it raised, and the traceback of that."""
    try:
        return function(*arguments), None, ""
    except Exception as error:  # of any kind: the parent raises it
        return None, _portable(error), traceback.format_exc()


def _portable(error: Exception) -> Exception:
    """The error, or one that says the same if it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever its constructor makes of its arguments
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


@contextmanager
def _interrupts_held(again: bool) -> Iterator[None]:
    """Within, Ctrl-C interrupts nothing; `again` says whether to let it do so afterwards."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if heard and again:
        signal.raise_signal(signal.SIGINT)


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
