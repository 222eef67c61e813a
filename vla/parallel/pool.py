"""The worker pool of collection, evaluation and exports.

Every process creates its own worker at its first item and keeps it. A result depends on its item alone.
"""

from __future__ import annotations

import itertools
import logging
import pickle
import signal
import threading
from collections.abc import Iterable, Iterator
from concurrent import futures
from contextlib import AbstractContextManager, closing, contextmanager
from multiprocessing import resource_tracker
from typing import Any, Literal

from vla.io.errors import UserError
from vla.io.types import Count
from vla.parallel.limits import cores
from vla.parallel.processes import ProcessEnded, Worker, WorkerFactory, WorkerProcess, allow_many_files, one_thread_each

log = logging.getLogger(__name__)


class WorkersLost(UserError):
    """Loss of workers that crashed or were killed; a retry with new ones may succeed."""


class WorkerCrash(WorkersLost):
    """Crash of every process that attempted one item; other items are not affected."""


class Cluster:
    """Spawned processes of this machine; a single worker runs in this process."""

    def __init__(self, workers: Count | None, policy: Literal["beside", "here"]) -> None:
        """Describe the workers; they are started by `pool`.

        Args:
            workers: their number; None: one per core.
            policy: "beside" runs a policy in the process of every worker, "here" one for all of them in this process.
        """
        self.workers, self.policy = workers or cores(), policy

    @contextmanager
    def pool(self, make: WorkerFactory) -> Iterator[Pool]:
        """Run workers for the duration of the context; `make` is called once in every process."""
        with one_thread_each():
            if self.workers == 1:
                with closing(make()) as worker:
                    yield _SerialPool(worker)
            else:
                with ProcessPool(make, self.workers) as pool:
                    yield pool


THIS_PROCESS = Cluster(1, "beside")


class _SerialPool:
    """A pool of one worker in this process, whose futures compute their result when asked for it."""

    size = 1

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    def submit(self, item: Any) -> _LazyFuture:
        """Submit an item."""
        return _LazyFuture(self._worker, item)

    def as_completed(self, pending: Iterable[Any]) -> Iterator[Any]:
        """Yield futures in their order."""
        return iter(pending)


class _LazyFuture:
    """Future that computes its result on demand."""

    def __init__(self, worker: Worker, item: Any) -> None:
        self._worker, self._item = worker, item

    def result(self) -> Any:
        """Return the result; raises the error of the attempt."""
        return self._worker.attempt(self._item)

    def cancel(self) -> None:
        """Do nothing: work starts only in `result`."""


class ProcessPool(AbstractContextManager["ProcessPool"]):
    """Spawned processes with one worker each, which start on demand; a GL context would not survive a fork.

    Every process belongs to one thread of this process, which sends it items and waits for the results. When a process
    crashes, a new one retries its item once: in long runs processes occasionally crash outside Python. Only this
    process handles Ctrl-C; leaving the context by an exception kills the others at once.
    """

    def __init__(self, make: WorkerFactory, size: int) -> None:
        allow_many_files()
        self.size, self._make = size, pickle.dumps(make)
        self._lock = threading.Lock()
        self._processes: list[WorkerProcess] = []
        self._closed = False
        self._local, self._numbers = threading.local(), itertools.count()
        self._threads = futures.ThreadPoolExecutor(size, initializer=self._enter_thread)

    def submit(self, item: Any) -> futures.Future[Any]:
        """Process an item as soon as a process is idle.

        The future raises the error of the worker factory or of the attempt, `WorkerCrash` if two processes ended in
        succession, or a UserError if one ended before its worker existed.
        """
        return self._threads.submit(self._attempt, item)

    def as_completed(self, pending: Iterable[Any]) -> Iterator[Any]:
        """Yield futures as they complete."""
        return futures.as_completed(pending)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all processes: after their current item on normal exit, at once after an exception or Ctrl-C."""
        with self._lock:
            self._closed = True
        try:
            if kind is None:
                self._threads.shutdown(cancel_futures=True)
                for process in self._processes:
                    process.dismiss()
                for process in self._processes:
                    process.join()
        finally:
            for process in self._processes:
                process.kill()
            self._threads.shutdown(cancel_futures=True)

    def _enter_thread(self) -> None:
        # Processes inherit the signal mask of the thread that starts them; starting the tracker would reset it.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._local.process, self._local.number = None, next(self._numbers)

    def _attempt(self, item: Any) -> Any:
        try:
            return self._ask(item)
        except ProcessEnded as end:
            if not self._closed:
                log.warning("a worker process crashed (%s); trying again", end)
        try:
            return self._ask(item)
        except ProcessEnded as end:
            way_out = "lower cluster.workers, or set PYTHONFAULTHANDLER=1 to see where"
            raise WorkerCrash(f"a worker process crashed twice: {end}; {way_out}") from end

    def _ask(self, item: Any) -> Any:
        process = self._process()
        try:
            return process.ask(item)
        except ProcessEnded:
            self._local.process = None
            self._forget(process)
            raise

    def _forget(self, process: WorkerProcess) -> None:
        """Release the resources of a process that has ended; a closed pool does so for all processes."""
        with self._lock:
            if not self._closed:
                self._processes.remove(process)
                process.release()

    def _process(self) -> WorkerProcess:
        """Return the process of this thread, started and with its worker created."""
        if self._local.process is None:
            with self._lock:
                if self._closed:
                    raise WorkersLost("the pool is closed")
                process = WorkerProcess(self._make, self._local.number)
                self._processes.append(process)
            try:
                process.answer()
            except ProcessEnded as end:
                killed = process.killed
                self._forget(process)
                if killed:
                    raise
                raise UserError(
                    f"a worker process could not start: {end}, see its output, or run with cluster.workers=1"
                ) from end
            self._local.process = process
        return self._local.process


Pool = _SerialPool | ProcessPool
Future = _LazyFuture | futures.Future[Any]
