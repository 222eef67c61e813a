"""Client of a policy server that speaks openpi's protocol, as an agent.

`vla.io.array_messages` describes the encoding, `vla.deploy.server` the protocol.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Coroutine, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from PIL import Image, ImageOps
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, InvalidURI, WebSocketException
from websockets.uri import parse_uri

from vla.io.array_messages import pack, unpack
from vla.io.errors import UserError
from vla.io.types import Count, ImageSize, Natural, NonNegative, Positive, Text
from vla.rollouts.realtime import IDEAL, BackgroundLink, RealTime, SimulatedLink
from vla.spec import Array, Observation, Spec

log = logging.getLogger(__name__)

Result = TypeVar("Result")


@dataclass(frozen=True)
class Component:
    """A component of our action, computed from the server's: `scale` * value at `index` + `offset`, then clipped."""

    index: Natural
    scale: float
    offset: float


@dataclass(kw_only=True)
class RemotePolicy:
    """A policy behind a WebSocket, which acts like one in this process.

    Attributes:
        url: of the server, as in ws://127.0.0.1:8000.
        images: camera → key of the server's observation, a list of keys for a map within maps, or null if it is not
            sent; other cameras are not sent either, and those that the world lacks are ignored.
        channels_first: send images as (3, H, W) instead of (H, W, 3).
        image_size: height and width to resize images to [px]; null: as they are.
        state: key of the server's observation → our state components; null: all of them.
        prompt: key of the instruction.
        actions: our action component → how to compute it; null: the server's actions are ours.
        execute: actions of each chunk to execute; null: as many as the server says, or all.
        asynchronous: act at the spec's control rate by the clock, and go on with the chunk, or hold, while the server
            computes the next one; else wait for it.
        ensemble: as of `vla.rollouts.realtime.Network`; null: only the newest chunk counts.
        timeout: longest time to wait for an answer [s].
        api_key: sent to `url` alone, as Authorization: Api-Key …
        spec: of the environment.

    Raises:
        UserError: the mapping does not fit the spec, or the server does not respond.
    """

    url: Text
    images: dict[str, Text | list[Text] | None]
    channels_first: bool
    image_size: ImageSize | None
    state: dict[str, list[Text] | None]
    prompt: Text
    actions: dict[str, Component] | None
    execute: Count | None
    asynchronous: bool
    ensemble: NonNegative | None
    timeout: Positive
    api_key: Text | None
    spec: Spec

    def __post_init__(self) -> None:
        """Check the mapping, and connect."""
        cameras = self.spec.cameras
        self._images = {camera: key for camera, key in self.images.items() if key and camera in cameras}
        if not self._images:
            raise UserError(
                f"agent.images has no key for the world's cameras, {', '.join(cameras)}: add "
                f"+agent.images.{cameras[0]}=KEY"
            )
        world_size, server_size = self.spec.image_size, self.image_size or self.spec.image_size
        if world_size[0] < server_size[0] and world_size[1] < server_size[1]:
            text = "images of %d x %d px are enlarged to the %d x %d px of agent.image_size: set task.image_size"
            log.warning(text, *world_size, *server_size)
        names = {name for names in self.state.values() for name in names or ()}
        if unknown := sorted(names - {*self.spec.state}):
            state = ", ".join(self.spec.state)
            raise UserError(f"agent.state names {', '.join(unknown)}, which the world's state lacks: it has {state}")
        if self.actions is not None and sorted(self.actions) != sorted(self.spec.action):
            raise UserError(f"agent.actions must map {', '.join(self.spec.action)}, got {', '.join(self.actions)}")
        self.info: dict[str, Any] = {}
        self._broken, self._warned, self._configured_execute = False, False, self.execute
        self._low, self._high = np.array(self.spec.low, np.float32), np.array(self.spec.high, np.float32)
        with ExitStack() as stack:
            self._connection = stack.enter_context(closing(Connection(self.url, self.timeout, self.api_key)))
            self._adopt_metadata()
            self._resources = stack.pop_all()
        if self.asynchronous:
            link = self._resources.enter_context(closing(BackgroundLink(self.plan, self.spec.control_hz)))
        else:
            link = SimulatedLink(self.plan, IDEAL, self.spec.control_hz)
        self._real_time = RealTime(self.spec, link, lambda: self.execute or 1, self.ensemble)

    def _adopt_metadata(self) -> None:
        """Compare the server's metadata, such as `vla.deploy.server` sends, with the spec; adopt how to use its chunks.

        Raises:
            UserError: its actions have other names, and no mapping is given.
        """
        self.metadata = self._connection.metadata
        action, rate = self.metadata.get("action"), self.metadata.get("control_hz")
        names = action.get("names") if isinstance(action, dict) else None
        if self.actions is None and isinstance(names, list) and names != list(self.spec.action):
            peer, world = ", ".join(map(str, names)), ", ".join(self.spec.action)
            raise self._connection.error(f"its actions are {peer[:200]}, the world's {world[:200]}: set agent.actions")
        if isinstance(rate, int | float) and abs(rate - self.spec.control_hz) > 0.01 * self.spec.control_hz:
            log.warning("%s acts at %g Hz, the world at %g Hz", self.url, rate, self.spec.control_hz)
        execute, history = (
            number if isinstance(number := self.metadata.get(name), int) and number >= 1 else None
            for name in ("execute", "history")
        )
        self.history = history or 1  # frames of a window; above 1 every observation is sent
        # A running plan is returned to the server in its own actions, which a mapping cannot restore.
        self.chunking = self.metadata.get("chunking") is True and self.actions is None
        self.execute = self._execute_limit = self._configured_execute or (1 if self.history > 1 else execute)

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode: drop all chunks, reconnect after an error, and notify a server that supports resets."""
        self._real_time.reset(seed)
        if self._broken:
            self._connection.connect()
            self._adopt_metadata()
            self._broken = False
        if self.metadata.get("reset") is True:
            self._ask({"reset": True, "prompt": instruction, "seed": seed})

    @property
    def looks(self) -> bool:
        """Whether the next observation may be sent."""
        return self._real_time.looks

    def act(self, observation: Observation) -> Array:
        """Return the next action, (D,) float32, clipped to the spec; `info` has the time of the last answer.

        Raises:
            UserError: the server refuses the observation, fails, is too slow, or answers with something else.
        """
        return self._real_time.act(observation)

    def plan(self, observation: Observation) -> Array:
        """Return the server's chunk, (k, D) float32, clipped; its first `execute` are executed. Raises as `act`."""
        start = time.perf_counter()
        answer = self._ask(self.message(observation))
        self.info = {"answer_ms": 1000 * (time.perf_counter() - start)}
        actions = self._translate(answer.get("actions"))
        self.execute = min(self._execute_limit or len(actions), len(actions))
        return actions

    def _ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        self._broken = True  # until it has answered: after an error, too, a server closes the connection
        answer = self._connection.ask(message)
        self._broken = False
        return answer

    def close(self) -> None:
        """Close the connection."""
        self._resources.close()

    def message(self, observation: Observation) -> dict[str, Any]:
        """Return the observation with the server's keys."""
        content: dict[str, Any] = {
            key: observation.state if names is None else observation.state[self.spec.indices(names)]
            for key, names in self.state.items()
        }
        content[self.prompt] = observation.instruction
        if observation.running is not None and self.chunking:
            content["running"] = {"actions": observation.running.actions, "delay": observation.running.delay}
        for camera, key in self._images.items():
            image = _resize(observation.rgb[camera], self.image_size)
            *path, name = [key] if isinstance(key, str) else key
            mapping = content
            for part in path:
                mapping = mapping.setdefault(part, {})
            mapping[name] = np.ascontiguousarray(image.transpose(2, 0, 1)) if self.channels_first else image
        return content

    def _translate(self, actions: Any) -> Array:
        """Convert the server's chunk to ours, (k, D)."""
        if not isinstance(actions, np.ndarray) or actions.ndim != 2 or 0 in actions.shape:
            shape = getattr(actions, "shape", type(actions).__name__)
            raise self._connection.error(f"its actions must be a chunk (k, D), got {shape}")
        mapping = self.actions or {name: Component(index, 1.0, 0.0) for index, name in enumerate(self.spec.action)}
        columns, width = [mapping[name] for name in self.spec.action], actions.shape[1]
        if width <= max(column.index for column in columns) or (self.actions is None and width != len(columns)):
            names = ", ".join(self.spec.action)
            raise self._connection.error(f"its actions have {width} components, the world's {names}: set agent.actions")
        unclipped = np.stack([column.scale * actions[:, column.index] + column.offset for column in columns], 1)
        if not np.isfinite(unclipped).all():
            raise self._connection.error("an action is not finite")
        clipped = np.clip(unclipped.astype(np.float32), self._low, self._high)
        if not self._warned and (np.abs(unclipped - clipped) > self._high - self._low).any():
            self._warned = True
            problem = f"actions of {self.url} are far beyond the bounds of the world"
            log.warning("%s, to which they are clipped: convert their units with agent.actions", problem)
        return clipped


class Connection:
    """A WebSocket to a policy server, in a thread with an event loop of its own.

    The loop answers pings between messages, and Python's TLS sockets lose data if two threads read and write at once.
    """

    def __init__(self, url: str, timeout: float, api_key: str | None) -> None:
        """Connect; `timeout` is the longest time to wait for an answer [s]. Raises as `RemotePolicy`."""
        self.url, self.timeout = url, timeout
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._socket: ClientConnection | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="connection", daemon=True)
        self._thread.start()
        try:
            self.connect()
        except BaseException:
            self.close()
            raise

    def connect(self) -> None:
        """Connect, or reconnect; `metadata` is then what the server tells about its policy."""
        try:
            self.metadata = self._wait(self._connect())
        except InvalidStatus as error:
            body = bytes(error.response.body or b"").decode(errors="replace").strip()[:200]
            body = f"{body}: set VLA_API_KEY" if "API key" in body else body
            raise self.error(body or f"HTTP status {error.response.status_code}") from error
        except (OSError, WebSocketException) as error:  # a time-out is an OSError without a text
            reason = error if str(error) else f"no answer within {self.timeout:g} s"
            raise UserError(f"no policy server at {self.url} ({reason}): start it, or set agent.url") from error

    async def _connect(self) -> dict[str, Any]:
        await self._disconnect()
        try:
            uri = parse_uri(self.url)
            self._socket = await connect(
                self.url,
                host=uri.host,  # where host and port are given, redirections elsewhere are refused
                port=uri.port,
                proxy=None,  # ignore proxies of the environment
                compression=None,
                max_size=2**26,
                additional_headers=self._headers,
                open_timeout=self.timeout,
                close_timeout=self.timeout,
                ping_timeout=self.timeout,
            )
        except (ValueError, InvalidURI) as error:
            raise UserError(
                f"agent.url={self.url[:200]} leads to no policy server ({error}): give one like ws://127.0.0.1:8000"
            ) from error
        return await asyncio.wait_for(self._receive(self._socket), self.timeout)

    def ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a message; raise a UserError if there is none."""
        assert self._socket is not None
        try:
            return self._wait(asyncio.wait_for(self._exchange(self._socket, pack(message)), self.timeout))
        except ConnectionClosed as error:
            reason = f" ({error.rcvd.reason})" if error.rcvd and error.rcvd.reason else ""
            raise self.error(f"it closed the connection{reason}") from error
        except TimeoutError as error:
            self._loop.call_soon_threadsafe(self._socket.transport.abort)  # a late answer would be taken for the next
            raise self.error(f"no answer within {self.timeout:g} s") from error

    async def _exchange(self, socket: ClientConnection, message: bytes) -> dict[str, Any]:
        await socket.send(message)
        return await self._receive(socket)

    async def _receive(self, socket: ClientConnection) -> dict[str, Any]:
        data = await socket.recv()
        if isinstance(data, str):
            raise self.error(data.strip().splitlines()[-1][:500] if data.strip() else "an empty error")
        answer = unpack(data)
        if not isinstance(answer, dict):
            raise self.error(f"its answer must be a map, got {type(answer).__name__}")
        return answer

    def _wait(self, work: Coroutine[Any, Any, Result]) -> Result:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _disconnect(self) -> None:
        if self._socket is not None:
            await self._socket.close()

    def error(self, reason: str) -> UserError:
        """Return an error that names the server."""
        return UserError(f"the policy server at {self.url} failed: {reason}")

    def close(self) -> None:
        """Close the connection, and end its thread."""
        self._wait(self._disconnect())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _resize(image: Array, size: Sequence[int] | None) -> Array:
    """Resize an (H, W, 3) image to `size` (height, width), with black borders where its aspect ratio differs."""
    if size is None or image.shape[:2] == tuple(size):
        return image
    return np.array(ImageOps.pad(Image.fromarray(image), (size[1], size[0]), Image.Resampling.BILINEAR))
