"""Dask cluster as a worker pool: several machines, with the same results as one."""

from __future__ import annotations

import asyncio
import logging
import re
import struct
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, SimpleQueue
from socket import gethostname
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from vla.io.errors import UserError
from vla.io.types import Positive
from vla.io.versions import installed_versions, normal_name
from vla.parallel.pool import Crashed, Pool, WorkersLost
from vla.parallel.processes import Worker, WorkerFactory, one_thread

if TYPE_CHECKING:
    import distributed

log = logging.getLogger(__name__)

CONNECT = 5.0  # timeout of the connection to the scheduler [s]


class DaskCluster:
    """Workers of a Dask cluster, which may join, leave and crash: their items are given to others.

    Every worker needs one thread. A Dask cluster runs any code that its clients send: use trusted networks only.
    """

    def __init__(self, address: str, patience: Positive) -> None:
        """Args:
        address: of the scheduler, tcp://HOST:PORT.
        patience: timeout for a result while there are no workers [s].

        Raises:
            UserError: Dask is not installed, or the address has another form.
        """
        if find_spec("distributed") is None:
            raise UserError("cluster=dask needs Dask, which is not installed: install vla[cluster]")
        if not re.fullmatch(r"tcp://.+:\d+", address):
            raise UserError(f"cluster.address must read tcp://HOST:PORT, got {address!r}")
        self.address, self.patience = address, patience

    @contextmanager
    def pool(self, make: WorkerFactory, needs: Sequence[Path] = ()) -> Iterator[Pool]:
        """See `Cluster`.

        Raises:
            UserError: no scheduler answers, it lacks a package, or it had no workers for `patience`.
        """
        from distributed import Client

        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # errors are raised below
        try:
            asyncio.run(_ping(self.address))
            client = Client(self.address, timeout=CONNECT)
        except (OSError, MemoryError, struct.error) as error:  # the latter two if another program answers
            raise UserError(
                f"no Dask scheduler answers at cluster.address={self.address}: start one with `dask scheduler`, "
                "or use this machine alone with cluster=local"
            ) from error
        with client:
            try:
                client.run_on_scheduler(callable, make)  # unpickling imports all modules that it names
            except ImportError as error:
                raise UserError(
                    f"the scheduler at {self.address} lacks a package ({error}): install vla[cluster] there and on the "
                    "machines of its workers"
                ) from error
            yield _DaskPool(client, partial(_make_checked, make, installed_versions(), tuple(needs)), self)


async def _ping(address: str) -> None:
    """Check that a scheduler answers in time: Dask's client waits without end for a server of another kind."""
    from distributed.comm import connect

    await (await asyncio.wait_for(connect(address), CONNECT)).close()


class _DaskPool:
    def __init__(self, client: distributed.Client, make: WorkerFactory, cluster: DaskCluster) -> None:
        self._client, self.cluster = client, cluster
        self._attempt = partial(_attempt, uuid4().hex, make)
        if not self._workers():
            log.info("waiting for workers to join %s", cluster.address)

    @property
    def size(self) -> int:
        return max(1, self._workers())

    def submit(self, item: Any) -> _DaskFuture:
        return _DaskFuture(self, self._client.submit(self._attempt, item, pure=False))

    def as_completed(self, pending: Iterable[Any]) -> Iterator[Any]:
        ended: SimpleQueue[_DaskFuture] = SimpleQueue()
        pending = list(pending)
        for item in pending:
            item.future.add_done_callback(lambda _, item=item: ended.put(item))
        for _ in pending:
            yield self._next(ended)

    def _next(self, ended: SimpleQueue[_DaskFuture]) -> _DaskFuture:
        while True:
            try:
                return ended.get(timeout=self.cluster.patience)
            except Empty:
                self.require_workers()

    def require_workers(self) -> None:
        """Raise a UserError if there are none, `WorkersLost` if there is no scheduler."""
        if not self._workers():
            raise UserError(
                f"{self.cluster.address} has had no worker for {self.cluster.patience:g} s: start workers and run again"
            )

    def _workers(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise self.lost() from error

    def lost(self) -> WorkersLost:
        return WorkersLost(f"the Dask scheduler at {self.cluster.address} went away")


class _DaskFuture:
    """Future of an item submitted to Dask."""

    def __init__(self, pool: _DaskPool, future: distributed.Future) -> None:
        self._pool, self.future = pool, future

    def result(self) -> Any:
        from distributed import KilledWorker
        from distributed.comm import CommClosedError

        while True:
            try:
                return self.future.result(timeout=self._pool.cluster.patience)
            except TimeoutError:
                if self.future.status == "error":
                    raise
            except (CancelledError, CommClosedError) as error:
                raise self._pool.lost() from error
            except KilledWorker as error:
                raise Crashed(
                    f"the workers of {self._pool.cluster.address} die, perhaps for lack of memory: see their output"
                ) from error
            self._pool.require_workers()

    def cancel(self) -> None:
        self.future.cancel()


_cached = threading.local()  # worker of this thread, to which its GL context is bound, and the pool it belongs to


def _attempt(pool: str, make: WorkerFactory, item: Any) -> Any:
    """Process an item with the worker that this thread caches for the pool."""
    if getattr(_cached, "pool", None) != pool:
        if hasattr(_cached, "worker"):
            _cached.worker.close()
            del _cached.worker, _cached.pool
        _cached.worker, _cached.pool = make(), pool
    return _cached.worker.attempt(item)


def _make_checked(make: WorkerFactory, versions: dict[str, str], needs: Sequence[Path]) -> Worker:
    """Create a worker on another machine, which loads libraries of the same `versions`: bit-exact results need them.

    Raises:
        UserError: that machine loads another version, or lacks a path in `needs`.
    """
    for path in needs:
        if not path.exists():
            raise UserError(f"{gethostname()} has no {path}: workers need it on a file system that all machines share")
    one_thread()
    try:
        return make()
    finally:
        loaded = {
            normal_name(name)
            for package, names in packages_distributions().items()
            if package in sys.modules
            for name in names
        }
        for name in sorted(loaded & {*versions}):
            if version(name) != versions[name]:
                raise UserError(
                    f"{gethostname()} has {name} {version(name)}, not {versions[name]}: install the same versions "
                    "everywhere"
                )
