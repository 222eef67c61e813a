"""Client of a policy server that speaks openpi's protocol, as an agent.

`vla.io.array_messages` describes the encoding, `vla.deploy.server` the protocol.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
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

# Units are wrong if more than this share of a chunk exceeds the bounds by more than this share of their range.
MAX_OUTLIER_SHARE, OUTLIER_DISTANCE = 0.25, 0.5


@contextmanager
def event_loop() -> Iterator[asyncio.AbstractEventLoop]:
    """Run an event loop in a thread of its own within the context.

    The connection lives there, as Python's TLS socket loses messages when two threads read and write at a time.
    """
    with asyncio.Runner() as runner:
        loop = runner.get_loop()
        thread = threading.Thread(target=loop.run_forever, name="connection", daemon=True)
        thread.start()
        try:
            yield loop
        finally:
            loop.call_soon_threadsafe(loop.stop)
            thread.join()


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
        self._images = {camera: key for camera, key in self.images.items() if key and camera in self.spec.cameras}
        if not self._images:
            cameras = self.spec.cameras
            raise UserError(
                f"agent.images has no key for the world's cameras, {', '.join(cameras)}: add "
                f"+agent.images.{cameras[0]}=KEY"
            )
        names = [name for names in self.state.values() for name in names or ()]
        _require_known("agent.state", names, self.spec.state, "state components")
        if self.actions is not None and sorted(self.actions) != sorted(self.spec.action):
            raise UserError(f"agent.actions must map {', '.join(self.spec.action)}, got {', '.join(self.actions)}")
        if self.image_size is not None and max(np.divide(self.image_size, self.spec.image_size)) > 1:
            size = f"[{self.image_size[0]},{self.image_size[1]}]"
            log.warning("agent.image_size=%s enlarges the images of the world: set task.image_size=%s", size, size)
        self.info: dict[str, Any] = {}
        self._broken = self._warned = False
        self._configured_execute = self.execute
        self._low, self._high = np.array(self.spec.low, np.float32), np.array(self.spec.high, np.float32)
        with ExitStack() as opened:
            self._loop = opened.enter_context(event_loop())
            self._connect(opened)
            self._open = opened.pop_all()
        if self.asynchronous:
            link = BackgroundLink(self.plan, self.spec.control_hz)
            self._open.callback(link.close)
        else:
            link = SimulatedLink(self.plan, IDEAL, self.spec.control_hz)
        self._real_time = RealTime(self.spec, link, lambda: self.execute or 1, self.ensemble)

    def _connect(self, opened: ExitStack) -> None:
        """Connect, and adopt the metadata of the server's policy. Raises as the class does."""
        self._connection, self.metadata = self._connected(opened)
        self._require_alike()
        advertised, history = (
            number if isinstance(number := self.metadata.get(name), int) and number >= 1 else None
            for name in ("execute", "history")
        )
        self.history = history or 1  # frames of a window; above 1 every observation is sent
        self._wanted = self._configured_execute or (1 if self.history > 1 else advertised)

    def _require_alike(self) -> None:
        """Compare the server's metadata of its actions, as `vla.deploy.server` sends it, with the spec.

        Raises:
            UserError: its actions have other names, and no mapping is given.
        """
        action, rate = self.metadata.get("action"), self.metadata.get("control_hz")
        names = action.get("names") if isinstance(action, dict) else None
        if self.actions is None and isinstance(names, list) and names != list(self.spec.action):
            theirs, ours = ", ".join(map(str, names)), ", ".join(self.spec.action)
            raise self._error(f"its actions are {theirs[:200]}, ours are {ours[:200]}: set agent.actions")
        if isinstance(rate, int | float) and abs(rate - self.spec.control_hz) > 0.01 * self.spec.control_hz:
            log.warning("%s acts at %g Hz, the world at %g Hz", self.url, rate, self.spec.control_hz)

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode: drop all chunks, connect again if that broke, and tell a server that has episodes."""
        self._real_time.reset(seed)
        if self._broken:
            self._connect(self._open)
            self._broken = False
        if self.metadata.get("reset") is True:
            self._ask({"reset": True, "prompt": instruction, "seed": seed})

    def act(self, observation: Observation) -> Array:
        """Return the next action, (D,) float32, clipped to the spec; `info` has the time of the last answer.

        Raises:
            UserError: the server refuses the observation, fails, is too slow, or answers with something else.
        """
        return self._real_time.act(observation)

    def plan(self, observation: Observation) -> Array:
        """Return the server's chunk, (k, D) float32, clipped, of which `execute` are meant to act. Raises as `act`."""
        began = time.perf_counter()
        answer = self.ask(observation)
        self.info = {"answer_ms": 1000 * (time.perf_counter() - began)}
        actions = self._translated(answer.get("actions"))
        self.execute = min(self._wanted or len(actions), len(actions))
        return actions

    def ask(self, observation: Observation) -> dict[str, Any]:
        """Return the server's answer to an observation. Raises as `act` does."""
        return self._ask(self.message(observation))

    def close(self) -> None:
        """Close the connection."""
        self._open.close()

    def message(self, observation: Observation) -> dict[str, Any]:
        """Return the observation with the server's keys."""
        state = {
            key: observation.state if names is None else observation.state[self.spec.indices(names)]
            for key, names in self.state.items()
        }
        sent: dict[str, Any] = {**state, self.prompt: observation.instruction}
        for camera, key in self._images.items():
            image = _resized(observation.rgb[camera], self.image_size)
            *outer, name = [key] if isinstance(key, str) else key
            place = sent
            for each in outer:
                place = place.setdefault(each, {})
            place[name] = np.ascontiguousarray(image.transpose(2, 0, 1)) if self.channels_first else image
        return sent

    def _translated(self, actions: Any) -> Array:
        """Convert the server's chunk to ours, (k, D)."""
        if not isinstance(actions, np.ndarray) or actions.ndim != 2 or 0 in actions.shape:
            shape = getattr(actions, "shape", type(actions).__name__)
            raise self._error(f"actions are a chunk (k, D), not {shape}")
        wanted = self.actions or {name: Component(index, 1.0, 0.0) for index, name in enumerate(self.spec.action)}
        fits = actions.shape[1] > max(each.index for each in wanted.values())
        if not fits or (self.actions is None and actions.shape[1] != len(wanted)):
            names = ", ".join(self.spec.action)
            raise self._error(f"its actions have {actions.shape[1]} components, ours are {names}: set agent.actions")
        columns = [wanted[name] for name in self.spec.action]
        mine = np.stack([each.scale * actions[:, each.index] + each.offset for each in columns], 1)
        if not np.isfinite(mine).all():
            raise self._error("an action is not finite")
        clipped = np.clip(mine.astype(np.float32), self._low, self._high)
        outlying = np.abs(mine - clipped) > OUTLIER_DISTANCE * (self._high - self._low)
        if not self._warned and outlying.mean() > MAX_OUTLIER_SHARE:
            self._warned = True
            where = f"actions of {self.url} are far beyond the bounds of the world"
            log.warning("%s: set agent.actions to its units", where)
        return clipped

    def _connected(self, opened: ExitStack) -> tuple[ClientConnection, dict[str, Any]]:
        times = {"open_timeout": self.timeout, "close_timeout": self.timeout, "ping_timeout": self.timeout}
        headers = {"Authorization": f"Api-Key {self.api_key}"} if self.api_key else None

        async def connected() -> ClientConnection:
            try:
                # No proxy of the environment; and where host and port are given, redirections elsewhere are refused.
                place = {"host": parse_uri(self.url).host, "port": parse_uri(self.url).port, "proxy": None}
                options = {"compression": None, "max_size": 2**26, "additional_headers": headers}
                return await connect(self.url, **place, **options, **times)
            except (ValueError, InvalidURI) as error:
                raise UserError(
                    f"agent.url={self.url[:200]} leads to no policy server ({error}): it looks like ws://127.0.0.1:8000"
                ) from error

        try:
            connection = self._wait(connected())
            opened.callback(lambda: self._wait(connection.close()))
            metadata = self._wait(asyncio.wait_for(self._received(connection), self.timeout))
        except InvalidStatus as error:
            said = bytes(error.response.body or b"").decode(errors="replace").strip()[:200]
            raise self._error(
                f"{said}: set VLA_API_KEY" if "API key" in said else said or f"HTTP status {error.response.status_code}"
            ) from error
        except (OSError, WebSocketException) as error:  # a time-out is an OSError without a text
            reason = error if str(error) else f"no answer within {self.timeout:g} s"
            raise UserError(f"no policy server at {self.url} ({reason}): start it, or set agent.url") from error
        return connection, metadata

    def _ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        async def answered() -> dict[str, Any]:
            await self._connection.send(pack(message))
            return await self._received(self._connection)

        self._broken = True  # until it has answered: after an error, too, a server closes the connection
        try:
            answer = self._wait(asyncio.wait_for(answered(), self.timeout))
        except ConnectionClosed as error:
            reason = f" ({error.rcvd.reason})" if error.rcvd and error.rcvd.reason else ""
            raise self._error(f"it closed the connection{reason}") from error
        except TimeoutError as error:
            self._loop.call_soon_threadsafe(self._connection.transport.abort)  # a late answer would be the next one's
            raise self._error(f"no answer within {self.timeout:g} s") from error
        self._broken = False
        return answer

    def _wait(self, work: Coroutine[Any, Any, Result]) -> Result:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _received(self, connection: ClientConnection) -> dict[str, Any]:
        data = await connection.recv()
        if isinstance(data, str):
            raise self._error(data.strip().splitlines()[-1][:500] if data.strip() else "an empty error")
        answer = unpack(data)
        if not isinstance(answer, dict):
            raise self._error(f"an answer is a map, not {type(answer).__name__}")
        return answer

    def _error(self, what: str) -> UserError:
        return UserError(f"the policy server at {self.url} failed: {what}")


def _resized(image: Array, size: Sequence[int] | None) -> Array:
    """Resize an (H, W, 3) image to `size` (height, width), with black borders where its aspect ratio differs."""
    if size is None or image.shape[:2] == tuple(size):
        return image
    return np.array(ImageOps.pad(Image.fromarray(image), (size[1], size[0]), Image.Resampling.BILINEAR))


def _require_known(key: str, names: Any, known: Sequence[str], what: str) -> None:
    if unknown := [str(name) for name in names if name not in known]:
        raise UserError(f"{key} names {', '.join(unknown)}, the {what} are {', '.join(known)}")
