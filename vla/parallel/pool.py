"""The worker pool of collection, evaluation and exports: its interface and its implementation on this machine.

Every process creates its own worker at its first item and keeps it. A result depends on its item alone, so it is the
same on every machine.
"""

from __future__ import annotations

import itertools
import logging
import pickle
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent import futures
from contextlib import AbstractContextManager, closing, contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Literal, Protocol

from vla.io.errors import UserError
from vla.io.types import Count
from vla.parallel.limits import cores
from vla.parallel.processes import ProcessEnded, Worker, WorkerFactory, WorkerProcess, one_thread_each

log = logging.getLogger(__name__)


class WorkersLost(UserError):
    """Loss of workers that crashed, were killed or became unreachable; a retry with new ones may succeed."""


class Crashed(WorkersLost):
    """Crash of every process that attempted one item; other items are not affected."""


class Future(Protocol):
    """Pending result of one item."""

    def result(self) -> Any:
        """Wait for the result; raises the error of the worker factory or of the attempt, or `WorkersLost`."""
        ...

    def cancel(self) -> object:
        """Drop the item if nobody has begun with it."""
        ...


class Pool(Protocol):
    """Workers that process items in parallel."""

    @property
    def size(self) -> int:
        """Current number of workers, at least one."""
        ...

    def submit(self, item: Any) -> Future:
        """Submit an item."""
        ...

    def as_completed(self, pending: Iterable[Any]) -> Iterator[Any]:
        """Yield futures as they complete."""
        ...


class Cluster(Protocol):
    """Machines that workers run on."""

    def pool(self, make: WorkerFactory, needs: Sequence[Path] = ()) -> AbstractContextManager[Pool]:
        """Run workers for the duration of the context.

        Args:
            make: factory of a worker, called once in every process.
            needs: absolute paths of the files and folders that workers read or write.
        """
        ...


class LocalCluster:
    """Spawned processes of this machine; a single worker runs in this process."""

    def __init__(self, workers: Count | None, policy: Literal["beside", "here"]) -> None:
        """Args:
        workers: their number; None: one per core.
        policy: whether a policy runs beside each worker, or here, in this process, once for all of them.
        """
        self.workers, self.policy = workers or cores(), policy

    @contextmanager
    def pool(self, make: WorkerFactory, needs: Sequence[Path] = ()) -> Iterator[Pool]:
        """See `Cluster`."""
        with one_thread_each():
            if self.workers == 1:
                with closing(make()) as worker:
                    yield _SerialPool(worker)
            else:
                with ProcessPool(make, self.workers) as pool:
                    yield pool


THIS_PROCESS = LocalCluster(1, "beside")


class _SerialPool:
    size = 1

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    def submit(self, item: Any) -> Future:
        return _LazyResult(self._worker, item)

    def as_completed(self, pending: Iterable[Any]) -> Iterator[Any]:
        return iter(pending)


class _LazyResult:
    """Future that computes its result on demand."""

    def __init__(self, worker: Worker, item: Any) -> None:
        self._worker, self._item = worker, item

    def result(self) -> Any:
        return self._worker.attempt(self._item)

    def cancel(self) -> None:
        """Do nothing: without `result` nobody begins."""


class ProcessPool:
    """Spawned processes with one worker each; a GL context would not survive a fork.

    Every process belongs to one thread of this process, which sends it items and waits for the results. When a process
    crashes, a new one retries its item once: in long runs processes occasionally crash outside Python. Only this
    process handles Ctrl-C; leaving the context by an exception kills the others at once.
    """

    def __init__(self, make: WorkerFactory, size: int) -> None:
        self.size, self._make = size, pickle.dumps(make)
        self._lock = threading.Lock()
        self._processes: list[WorkerProcess] = []
        self._closed = False
        self._own, self._numbers = threading.local(), itertools.count()
        self._threads = futures.ThreadPoolExecutor(size, initializer=self._enter_thread)

    def submit(self, item: Any) -> futures.Future[Any]:
        """Process an item as soon as a process is idle.

        The future raises the error of the worker factory or of the attempt, `Crashed` if two processes ended in
        succession, or a UserError if one ended before its worker existed.
        """
        return self._threads.submit(self._attempt, item)

    def as_completed(self, pending: Iterable[Any]) -> Iterator[Any]:
        """See `Pool`."""
        return futures.as_completed(pending)

    def __enter__(self) -> ProcessPool:
        """Enter the context; processes start on demand."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all processes: after their current item on normal exit, at once after an exception."""
        with _interrupts_deferred(again=kind is None):
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
        # Processes inherit the signal mask of the thread that starts them; starting the tracker would reset it.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._own.process, self._own.number = None, next(self._numbers)

    def _attempt(self, item: Any) -> Any:
        try:
            return self._process().ask(item)
        except ProcessEnded as end:
            if not self._closed:
                log.warning("a worker process crashed (%s); trying again", end)
        self._own.process = None
        try:
            return self._process().ask(item)
        except ProcessEnded as end:
            self._own.process = None
            raise Crashed(f"a worker process crashed twice: {end}; cluster.workers=1 shows the traceback") from end

    def _process(self) -> WorkerProcess:
        """Return the process of this thread, started and with its worker created."""
        if self._own.process is None:
            with self._lock:
                if self._closed:
                    raise WorkersLost("the pool is closed")
                process = WorkerProcess(self._make, self._own.number)
                self._processes.append(process)
            try:
                process.answer()
            except ProcessEnded as end:
                if process.killed:
                    raise
                raise UserError(
                    f"a worker process could not start: {end}, see its output, or run with cluster.workers=1"
                ) from end
            self._own.process = process
        return self._own.process


@contextmanager
def _interrupts_deferred(again: bool) -> Iterator[None]:
    """Suppress Ctrl-C within the context; with `again` it is raised at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if received and again:
        signal.raise_signal(signal.SIGINT)
