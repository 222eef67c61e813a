"""Where seeds are attempted: in processes of this machine, or on the workers of a Dask cluster.

Every process makes its own worker when its first seed comes and keeps it. What comes back depends on the seed alone,
so it is the same wherever it was made.
"""

from __future__ import annotations

import asyncio
import logging
import re
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from socket import gethostname
from typing import TYPE_CHECKING, Any, Protocol
from uuid import uuid4

from vla.types import Count, Positive
from vla.workers import MakeWorker, Pool, Worker, WorkersLost, cores, one_thread, one_thread_each

if TYPE_CHECKING:
    import distributed

log = logging.getLogger(__name__)

CONNECT = 5.0  # [s] in which a scheduler that is there has answered
LIBRARIES = ("dm-control", "mujoco", "numpy")  # whose versions decide what an episode looks like, bit for bit


Wait = Callable[[], Any]


class Team(Protocol):
    """Workers side by side."""

    @property
    def size(self) -> int:
        """How many there are now, at least one."""
        ...

    def submit(self, seed: int) -> Wait:
        """Start the attempt at `seed`; gives the function that waits for its result, or raises what it raised."""
        ...


class Cluster(Protocol):
    """A place for workers."""

    def team(self, make: MakeWorker) -> AbstractContextManager[Team]:
        """The workers that `make` makes there, while the context lasts; working with them may raise `WorkersLost`."""
        ...


class Local:
    """Spawned processes of this machine; a single worker is this process itself."""

    def __init__(self, workers: Count | None = None) -> None:
        """`workers` is how many, None: one per core."""
        self.workers = workers or cores()

    @contextmanager
    def team(self, make: MakeWorker) -> Iterator[Team]:
        """See `Cluster`."""
        with one_thread_each():
            if self.workers == 1:
                with closing(make()) as worker:
                    yield _Here(worker)
            else:
                with Pool(make, self.workers, "collect.workers") as pool:
                    yield _Processes(pool, self.workers)


class _Here:
    size = 1

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    def submit(self, seed: int) -> Wait:
        return partial(self._worker.attempt, seed)


class _Processes:
    def __init__(self, pool: Pool, size: int) -> None:
        self.size, self._pool = size, pool

    def submit(self, seed: int) -> Wait:
        return partial(self._result, self._pool.submit(seed))

    @staticmethod
    def _result(future: Future[Any]) -> Any:
        try:
            return future.result()
        except WorkersLost as lost:
            raise WorkersLost(
                f"a collecting process crashed twice ({lost}): what was committed is safe, run again with fewer "
                "collect.workers, or with 1 to see the crash"
            ) from lost


class Dask:
    """The workers of a Dask cluster, which may come, go and crash: their seeds are given to others.

    They want one thread each. A Dask cluster runs whatever its clients send, so it belongs on trusted networks only.
    """

    def __init__(self, address: str, patience: Positive = 60.0) -> None:
        """Args:
        address: of the scheduler, as tcp://HOST:PORT.
        patience: how long to wait for a result while there are no workers [s].

        Raises:
            ValueError: Dask is not installed, or the address reads otherwise.
        """
        if find_spec("distributed") is None:
            raise ValueError("cluster=dask needs Dask, which is not here: install vla[cluster]")
        if not re.fullmatch(r"tcp://.+:\d+", address):
            raise ValueError(f"cluster.address must read tcp://HOST:PORT, got {address!r}")
        self.address, self.patience = address, patience

    @contextmanager
    def team(self, make: MakeWorker) -> Iterator[Team]:
        """See `Cluster`.

        Raises:
            ValueError: no scheduler answers, it lacks a package, or it has had no workers for too long.
        """
        from distributed import Client

        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what goes wrong is raised below
        try:
            asyncio.run(_knock(self.address))
            client = Client(self.address, timeout=CONNECT)
        except (OSError, MemoryError, struct.error) as error:  # the latter where another program answers
            raise ValueError(
                f"no Dask scheduler answers at cluster.address={self.address}: start one with `dask scheduler`, "
                "or collect on this machine with cluster=local"
            ) from error
        with client:
            try:
                client.run_on_scheduler(callable, make)  # which arrives where all that it names can be imported
            except ImportError as error:
                raise ValueError(
                    f"the scheduler at {self.address} lacks something ({error}): install vla[cluster] there, and where "
                    "its workers run"
                ) from error
            yield _Remote(client, make, self)


async def _knock(address: str) -> None:
    """See whether a scheduler answers in time, which Dask's client leaves open where somebody else listens."""
    from distributed.comm import connect

    await (await asyncio.wait_for(connect(address), CONNECT)).close()


class _Remote:
    def __init__(self, client: distributed.Client, make: MakeWorker, cluster: Dask) -> None:
        self._client, self._cluster = client, cluster
        self._attempt = partial(_attempt, uuid4().hex, partial(_make_alike, make, _versions()))
        if not self._workers():
            log.info("waiting for workers to join %s", cluster.address)

    @property
    def size(self) -> int:
        return max(1, self._workers())

    def submit(self, seed: int) -> Wait:
        return partial(self._result, self._client.submit(self._attempt, seed, pure=False))

    def _result(self, future: distributed.Future) -> Any:
        from distributed import KilledWorker

        while True:
            try:
                return future.result(timeout=self._cluster.patience)
            except TimeoutError:
                if future.status == "error":
                    raise
            except CancelledError as error:
                raise self._gone() from error
            except KilledWorker as error:
                raise WorkersLost(
                    f"the workers of {self._cluster.address} die, killed for their memory or by a crash outside "
                    "Python: what was committed is safe, see what they print"
                ) from error
            if not self._workers():
                raise ValueError(
                    f"{self._cluster.address} has had no worker for {self._cluster.patience:g} s: what was committed "
                    "is safe, start workers and run again"
                )

    def _workers(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise self._gone() from error

    def _gone(self) -> WorkersLost:
        return WorkersLost(f"the Dask scheduler at {self._cluster.address} went away: what was committed is safe")


_held = threading.local()  # the worker of this thread, to which its GL context is bound, and the job it was made for


def _attempt(job: str, make: MakeWorker, seed: int) -> Any:
    """Attempt a seed with the worker that this process keeps for the job."""
    if getattr(_held, "job", None) != job:
        if hasattr(_held, "worker"):
            _held.worker.close()
            del _held.worker
        _held.worker, _held.job = make(), job
    return _held.worker.attempt(seed)


def _make_alike(make: MakeWorker, versions: dict[str, str]) -> Worker:
    """A worker on another machine, whose episodes are the same as here, bit for bit."""
    if _versions() != versions:
        raise ValueError(f"{gethostname()} has {_versions()}, not {versions}: install the same versions everywhere")
    one_thread()
    return make()


def _versions() -> dict[str, str]:
    return {name: version(name) for name in LIBRARIES}
