"""A policy server that speaks openpi's protocol (openpi, src/openpi/serving/websocket_policy_server.py).

Over a WebSocket without compression it first sends its metadata, then one map with `actions` (k, D) for every
observation, all in the encoding of `vla.io.array_messages`. An error is sent as text and closes the connection.
`GET /healthz` answers OK. Beyond that protocol, the message {"reset": True, "prompt": …, "seed": …} starts an episode:
it clears the history of the connection and seeds the noise of the model.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import math
import queue
import signal
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Le
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from vla.deploy.client_observation import Keys, instruction
from vla.io.array_messages import pack, unpack
from vla.io.errors import UserError, counted
from vla.io.types import Count, Text
from vla.parallel.processes import signal_event
from vla.rollouts.realtime import actions_per_plan
from vla.spec import Array, Environment, Observation

if TYPE_CHECKING:
    from vla.policy import Policy

FULL_MESSAGE = "no room beside {}: raise deploy.connections, or lower their cluster.workers\n"
PATIENCE = 3.0  # longest opening or closing of a connection by a client [s]
WARNINGS = 20  # most warnings about clients in a minute
INVALID, TOO_BIG, INTERNAL = 1007, 1009, 1011  # WebSocket close codes: invalid data, too large, error in the server

log = logging.getLogger(__name__)

Port = Annotated[int, Ge(0), Le(65535)]  # 0: any free one


@dataclass(kw_only=True)
class PolicyServer:
    """The policy behind openpi's protocol. Raises a UserError if other machines could connect without a key.

    Attributes:
        host, port: address to listen at.
        keys: where an observation has its images, state and instruction.
        connections: largest number of clients at a time.
        largest_message: of a client [bytes].
        api_key: what clients must send; needed to listen beyond this machine.
        origins: of web pages that may use the policy, such as http://localhost:3000.
        policy, environment: factories of the policy and of the task's environment.
        output: folder of results, unused.
    """

    host: Text
    port: Port
    keys: Keys
    connections: Count
    largest_message: Count
    api_key: Text | None
    origins: list[Text]
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path

    def __post_init__(self) -> None:
        if self.api_key is None and not _is_loopback(self.host):
            raise UserError(
                f"deploy.host={self.host} lets other machines use the policy: set the environment variable "
                "VLA_API_KEY, which clients must then know, or deploy.host=127.0.0.1"
            )

    def run(self) -> None:
        """Serve until interrupted; raise a UserError if the policy or the address cannot be served."""
        with self._address_errors():  # before a large policy is loaded, and perhaps compiled
            asyncio.run(_bind(self.host, self.port))
        policy = self.policy()
        if not hasattr(policy, "lanes"):  # an agent in its place
            raise UserError(
                f"deploy=server serves a trained policy, checkpoint=RUN; a {type(policy).__name__} cannot be served"
            )
        with (
            self._address_errors(),
            signal_event(signal.SIGINT, signal.SIGTERM) as stop,
            Service(self, policy).serve_in_thread() as url,
        ):
            log.info("serving the policy at %s", url)
            stop.wait()

    @contextmanager
    def _address_errors(self) -> Iterator[None]:
        """Convert an OSError into a UserError that names the address."""
        try:
            yield
        except OSError as error:
            address = f"deploy.host={self.host} deploy.port={self.port}"
            raise UserError(f"cannot listen at {address}: {error.strerror}; deploy.port=0 is any free one") from error


class Service:
    """A running server: all connections share the model, and inference runs in one thread beside the event loop."""

    def __init__(self, settings: PolicyServer, policy: Policy) -> None:
        self._settings, self._policy = settings, policy
        self._waiting: asyncio.Queue[tuple[int, Observation, asyncio.Future[Array]]] = asyncio.Queue()
        self._lanes = set[int]()  # of the policy, one for each connection
        self._warning_times = deque([-math.inf] * WARNINGS, WARNINGS)  # times of the last warnings [s]

    @contextmanager
    def serve_in_thread(self) -> Iterator[str]:
        """Serve in a thread of its own within the context; yield the URL."""
        with asyncio.Runner() as runner, ThreadPoolExecutor(1, "server") as thread:
            loop, url, stop = runner.get_loop(), queue.Queue[str](), asyncio.Event()

            async def serve() -> None:
                async with self._listen() as address:
                    url.put(address)
                    await stop.wait()

            future = thread.submit(runner.run, serve())
            future.add_done_callback(lambda _: url.put(""))  # it could not start
            try:
                if address := url.get():
                    yield address
            finally:
                loop.call_soon_threadsafe(stop.set)
                future.result()

    @asynccontextmanager
    async def _listen(self) -> AsyncIterator[str]:
        """Serve within the context; yield the URL once the first client can be answered."""
        settings, policy = self._settings, self._policy
        options: dict[str, Any] = {"compression": None, "max_size": settings.largest_message, "max_queue": 1}
        options |= {"origins": [None, *settings.origins], "process_request": self._answer_request}  # programs have none
        options |= {"open_timeout": PATIENCE, "close_timeout": PATIENCE}
        with ThreadPoolExecutor(1, "inference") as thread:
            # The first pass through a compiled model takes up to a minute.
            noise = policy.spec.random_observation(np.random.default_rng(0))
            await asyncio.get_running_loop().run_in_executor(thread, policy.plan, noise)
            async with serve(self._talk, settings.host, settings.port, **options) as server:
                inference = asyncio.create_task(self._infer(thread))
                host = f"[{settings.host}]" if ":" in settings.host else settings.host
                yield f"ws://{host}:{server.sockets[0].getsockname()[1]}"
            inference.cancel()

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer health checks; reject clients without the key, or beyond `connections`."""
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        key, header = self._settings.api_key, "".join(request.headers.get_all("Authorization"))
        if key is not None and not hmac.compare_digest(
            header.encode(errors="surrogateescape"), f"Api-Key {key}".encode()
        ):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "send the API key as Authorization: Api-Key …\n")
        if len(self._lanes) >= self._settings.connections:
            return connection.respond(
                HTTPStatus.SERVICE_UNAVAILABLE, FULL_MESSAGE.format(counted(len(self._lanes), "client"))
            )
        return None

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one client until it leaves or sends something invalid."""
        lane = next(lane for lane in count() if lane not in self._lanes)
        self._lanes.add(lane)
        self._policy.reset("", lane, lane)
        try:
            await connection.send(pack(metadata(self._policy, self._settings.keys)))
            async for data in connection:
                await connection.send(pack(await self._answer(lane, data)))
        except ConnectionClosed as closed:
            if closed.sent and closed.sent.code == TOO_BIG:
                self._warn("a client's message has more than deploy.largest_message bytes: %s", closed.sent.reason)
        except UserError as error:
            await self._refuse(connection, str(error), INVALID)
        except Exception:
            self._warn("a client's observation caused an error", exc_info=True)
            await self._refuse(connection, "the server failed, see its log", INTERNAL)
        finally:
            self._lanes.remove(lane)

    async def _refuse(self, connection: ServerConnection, sentence: str, code: int) -> None:
        self._warn("refused a client at %s: %s", connection.remote_address[0], " ".join(sentence.split())[:500])
        with suppress(ConnectionClosed):
            await connection.send(sentence)
            await connection.close(code, sentence.encode()[:120].decode(errors="ignore"))

    def _warn(self, text: str, *values: str, exc_info: bool = False) -> None:
        """Log a warning, unless there were `WARNINGS` within a minute: a client could fill the disk with them."""
        if (now := time.monotonic()) > self._warning_times[0] + 60:
            self._warning_times.append(now)
            log.warning(text, *values, exc_info=exc_info)

    async def _answer(self, lane: int, data: str | bytes) -> dict[str, Any]:
        if isinstance(data, str):
            raise UserError("an observation must be a binary message in msgpack, got text")
        message = unpack(data)
        if isinstance(message, Mapping) and message.get("reset") is True:
            seed = message.get("seed", lane)
            if type(seed) is not int or not 0 <= seed < 2**32:
                raise UserError(f"seed is {repr(seed)[:50]}, expected an integer from 0 to 2**32 - 1")
            self._policy.reset(instruction("prompt", message.get("prompt")), seed, lane)
            return {"reset": True}
        observation = self._settings.keys.observation(message, self._policy.spec)
        began, result = time.perf_counter(), asyncio.get_running_loop().create_future()
        self._waiting.put_nowait((lane, observation, result))
        return {"actions": await result, "server_timing": {"infer_ms": 1000 * (time.perf_counter() - began)}}

    async def _infer(self, thread: Executor) -> None:
        """Run inference on queued observations until cancelled, for as many clients at once as a pass serves."""
        while True:
            group = [await self._waiting.get()]
            while len(group) < self._policy.lanes and not self._waiting.empty():
                group.append(self._waiting.get_nowait())
            lanes, observations, results = zip(*group, strict=True)
            plans = asyncio.get_running_loop().run_in_executor(thread, self._policy.plan, observations, lanes)
            try:
                answers = [*zip(results, await plans, strict=True)]
            except Exception as error:
                for result in results:
                    result.set_exception(error)
            else:
                for result, actions in answers:
                    result.set_result(actions)


def metadata(policy: Policy, keys: Keys) -> dict[str, Any]:
    """Describe the policy to a client: layouts, units and bounds, and how to use its chunks.

    `horizon` is the length of a chunk, of which a client executes the first `execute` actions; a policy with a
    `history` of several frames needs every frame, so the client must send an observation at every step. With
    `chunking`, an observation may have the plan that is `running`: its remaining `actions` (n, D), and `delay`, the
    number of them that will have been executed when the answer arrives.
    """
    spec = policy.spec
    bounds = {"low": np.array(spec.low, np.float32), "high": np.array(spec.high, np.float32)}
    return {
        "server": "vla",
        "policy": type(policy.model).__name__,
        "images": {key: [*spec.size(camera), 3] for camera, key in keys.cameras(spec).items()},
        "state": {"keys": keys.state, "names": list(spec.state), "units": list(spec.state_units)},
        "prompt": keys.prompt,
        "action": {"names": list(spec.action), "units": list(spec.units), **bounds},
        "control_hz": spec.control_hz,
        "horizon": policy.model.chunk,
        "execute": actions_per_plan(policy),
        "history": policy.history,
        "chunking": policy.chunking is not None,
        "reset": True,
    }


async def _bind(host: str, port: int) -> None:
    """Listen at an address and stop at once; raise an OSError if that is not possible."""
    server = await asyncio.get_running_loop().create_server(asyncio.Protocol, host, port)
    server.close()


def _is_loopback(host: str) -> bool:
    """Return whether only this machine can connect to an address."""
    with suppress(ValueError):  # a name
        return ip_address(host).is_loopback
    return host == "localhost"
