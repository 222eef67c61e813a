"""One policy in this process for the worlds of all workers: images come through shared memory, the rest by a socket.

Observations that wait at the same time share a pass through the model. What a policy does in a lane depends on nothing
but its episode, so episodes are the same, bit for bit, as with a policy beside every worker.

Shapes: k action chunk, D action components.
"""

from __future__ import annotations

import logging
import os
import queue
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from errno import EMFILE, ENFILE, ENOBUFS, ENOMEM
from functools import partial
from itertools import count
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener
from multiprocessing.shared_memory import SharedMemory
from tempfile import TemporaryDirectory, gettempdir
from typing import Any, NamedTuple, Protocol

import numpy as np

from vla.io.errors import UserError, counted
from vla.parallel.processes import make_picklable, one_thread_each
from vla.spec import Agents, Array, Environment, Observation, RunningPlan, Spec

log = logging.getLogger(__name__)

MAX_WORKERS = 1024  # workers
STATE = "a state"  # beside the cameras in shared memory, as an error calls it
LONG_FOLDER = 60  # bytes of a path: that of a socket has at most 103, and folders of batch jobs are longer


class Request(NamedTuple):
    """A request of a worker to the policy."""

    kind: str  # "act", "plan" or "reset"
    lane: int
    content: Any  # the observation; for "reset", instruction and seed
    answer: Future[Any]


class _Planner(Agents, Protocol):
    """Agents that plan chunks, as `vla.policy.Policy`."""

    spec: Spec
    execute: int
    history: int

    def plan(self, observations: Sequence[Observation], lanes: Sequence[int], /) -> Array:
        """Return the chunks (n, k, D) of n lanes."""


@contextmanager
def shared_policy(make_policy: Callable[[], _Planner]) -> Iterator[Callable[[Environment], _DistantPolicy]]:
    """Run a policy for all workers on this machine within the context; yield the factory of their agents."""
    parent, key = "/tmp" if len(os.fsencode(gettempdir())) > LONG_FOLDER else None, secrets.token_bytes(32)
    with (
        one_thread_each(),
        TemporaryDirectory(prefix="vla-", dir=parent) as folder,
        Listener(f"{folder}/policy", "AF_UNIX", authkey=key) as listener,
    ):
        policy, requests = make_policy(), queue.Queue[Request | None]()
        with (
            ThreadPoolExecutor(1) as server,
            ExitStack() as cleanup,
            ThreadPoolExecutor(MAX_WORKERS) as talks,
            ThreadPoolExecutor(1) as acceptor,
        ):
            cleanup.callback(requests.put, None)  # once all talks have ended: each waits for its answers
            server.submit(_serve, policy, requests)
            acceptor.submit(_accept, listener, partial(talks.submit, _talk, policy, requests))
            try:
                yield partial(_DistantPolicy, str(listener.address), key)
            finally:
                with suppress(OSError), Client(listener.address, authkey=key) as client:
                    client.send(None)  # ends `_accept`, which would not notice that its socket is closed


def _accept(listener: Listener, begin: Callable[[int, Connection, Spec], Future[None]]) -> None:
    """Begin a talk with every worker that connects; it has a lane of its own until it leaves."""
    lanes = set[int]()
    while True:
        try:
            connection = listener.accept()
            if (spec := connection.recv()) is None:
                return
            lanes.add(lane := next(number for number in count() if number not in lanes))
            begin(lane, connection, spec).add_done_callback(lambda _, lane=lane: lanes.remove(lane))
        except (AuthenticationError, EOFError, ConnectionError):  # of other programs that find the socket
            continue
        except OSError as error:
            if error.errno in (EMFILE, ENFILE, ENOBUFS, ENOMEM):
                log.warning("a worker waits for the policy: %s", error)
                time.sleep(1)  # until another one has left


def _serve(policy: _Planner, requests: queue.Queue[Request | None]) -> None:
    """Answer requests until None arrives; those that wait at the same time share a call of the policy."""
    while (first_request := requests.get()) is not None:
        batch = [first_request]
        with suppress(queue.Empty):
            while (next_request := requests.get_nowait()) is not None:
                batch.append(next_request)
            requests.put(None)
        for kind, call in (("reset", partial(_reset, policy)), ("act", policy.act), ("plan", policy.plan)):
            if group := [request for request in batch if request.kind == kind]:
                _answer(call, group)


def _reset(policy: _Planner, episodes: Sequence[tuple[str, int]], lanes: Sequence[int]) -> Sequence[None]:
    return [policy.reset(instruction, seed, lane) for (instruction, seed), lane in zip(episodes, lanes, strict=True)]


def _answer(call: Callable[..., Iterable[Any]], requests: Sequence[Request]) -> None:
    """Answer requests together, or one by one if an observation is refused."""
    try:
        answers = [*call([request.content for request in requests], [request.lane for request in requests])]
        if len(answers) != len(requests):
            raise RuntimeError(
                f"the policy gave {counted(len(answers), 'answer')} to {counted(len(requests), 'request')}"
            )
    except Exception as error:  # of any kind: the worker raises it
        for request in requests:
            if isinstance(error, ValueError) and len(requests) > 1:  # then no lane has acted
                _answer(call, [request])
            else:
                request.answer.set_exception(error)
    else:
        for request, answer in zip(requests, answers, strict=True):
            request.answer.set_result(answer)


def _talk(
    policy: _Planner, requests: queue.Queue[Request | None], lane: int, connection: Connection, spec: Spec
) -> None:
    """Pass the requests of a worker, whose world has this spec, on to the policy until it leaves."""
    with connection, suppress(EOFError, OSError):  # it has left, or was killed
        try:
            memory = _new_memory(_layout(spec).itemsize)
        except (OSError, UserError) as error:
            return connection.send(make_picklable(error))
        try:
            connection.send((memory.name, policy.spec, policy.execute, policy.history))
            while True:
                kind, instruction, rest = connection.recv()
                content = (instruction, rest) if kind == "reset" else _observation(memory, spec, instruction, *rest)
                requests.put(Request(kind, lane, content, answer := Future()))
                error = answer.exception()
                reply = None if error else (answer.result(), policy.about(lane), policy.looking(lane))
                connection.send(make_picklable(error) if error else reply)
        finally:
            memory.close()
            memory.unlink()


def _new_memory(size: int) -> SharedMemory:
    """Allocate shared memory; a UserError if there is too little, of which the first use would end this process."""
    memory = SharedMemory(create=True, size=size)
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(memory._fd, 0, size)  # type: ignore[attr-defined]
    except OSError as error:
        memory.close()
        memory.unlink()
        raise UserError(
            f"there are no {size / 1e6:.1f} MB of shared memory for another worker ({error.strerror}): lower "
            "cluster.workers, set cluster.policy=beside, or start the container with a larger --shm-size"
        ) from error
    return memory


def _observation(
    memory: SharedMemory, spec: Spec, instruction: str, has_images: bool, running: RunningPlan | None
) -> Observation:
    """Return the observation of a worker: a copy of the arrays in its shared memory, and the parts that it sent."""
    arrays = np.ndarray((), _layout(spec), memory.buf).copy()
    images = {camera: arrays[camera] for camera in spec.cameras if has_images}
    return Observation(images, arrays[STATE], instruction, running=running)


def _layout(spec: Spec) -> np.dtype:
    """Return the layout of an observation in shared memory: camera → its image (H, W, 3), and `STATE` → (P,)."""
    images = [(camera, np.uint8, (*spec.image_size, 3)) for camera in spec.cameras]
    return np.dtype([*images, (STATE, np.float32, (len(spec.state),))])


class _DistantPolicy:
    """The agent of one world whose policy is in another process of this machine."""

    def __init__(self, address: str, key: bytes, environment: Environment) -> None:
        """Connect to a policy; raise a UserError if it has another spec than the environment."""
        self._world = environment.spec.without_truth
        self.info: dict[str, Any] = {}
        self.looks = True
        with ExitStack() as stack:  # hangs up if something fails
            self._connection = stack.enter_context(Client(address, authkey=key))
            self._connection.send(self._world)
            name, self.spec, self.execute, self.history = self._receive()
            self.spec.require_input(environment.spec, "the policy", "the task")
            self._memory = SharedMemory(name)
            stack.pop_all()

    def reset(self, instruction: str, seed: int) -> None:
        self._ask("reset", instruction, seed)

    def act(self, observation: Observation) -> Array:
        return self._show("act", observation)

    def plan(self, observation: Observation) -> Array:
        return self._show("plan", observation)

    def _show(self, kind: str, observation: Observation) -> Array:
        """Write an observation to the shared memory, and return the answer of the policy."""
        arrays: Mapping[str, Array] = {**observation.rgb, STATE: np.asarray(observation.state, np.float32)}
        layout = _layout(self._world)
        memory = np.ndarray((), layout, self._memory.buf)
        for name in layout.names or ():
            view, array = memory[name], arrays.get(name, memory[name])
            if (array.shape, array.dtype) != (view.shape, view.dtype):
                expected, actual = (f"{side.shape} {side.dtype}" for side in (view, array))
                raise UserError(f"the world gives {name} of {actual}, but its spec says {expected}")
            view[:] = array
        has_images = all(camera in arrays for camera in self._world.cameras)
        return self._ask(kind, observation.instruction, (has_images, observation.running))

    def _ask(self, kind: str, instruction: str, rest: object) -> Any:
        self._connection.send((kind, instruction, rest))
        result, self.info, self.looks = self._receive()
        return result

    def _receive(self) -> Any:
        """Return the next message of the policy's process; raise it if it is an error."""
        message = self._connection.recv()
        if isinstance(message, Exception):
            raise message
        return message

    def close(self) -> None:
        self._memory.close()
        self._connection.close()
