"""Play a served policy on Meta-World under LeRobot's protocol, with none of this project's code.

    pip install metaworld==3.0.0 mujoco==3.3.0 msgpack pyyaml websockets # in an environment of its own
    python -m vla.run job=deploy checkpoint=RUN deploy=server +deploy.keys.images.picture=observation/image
    python tools/parity/metaworld_client.py 1000000 2 OUTPUT [TASK,...]

The server gets one picture of 480 x 480 pixels, the first four numbers of Meta-World's observation, and the sentence.
Episode i of every task has the seed 1000000 + i. OUTPUT gets an `eval_info.json` for `metaworld_loops.py`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import metaworld
import msgpack
import numpy as np
import yaml
from websockets.sync.client import ClientConnection, connect

STEPS = 500  # at most
UNITS = np.array([100, 100, 100, -1], np.float32)  # the simulator's actions are in cm, and 1 closes


def _pack(value: Any) -> Any:
    array = np.ascontiguousarray(value)
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": array.shape}


def _unpack(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return np.frombuffer(value[b"data"], np.dtype(value[b"dtype"])).reshape(value[b"shape"])
    return value[b"data"] if b"__npgeneric__" in value else value


class Server:
    """A policy behind openpi's protocol, and what it says of itself: `about`."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.about = self._receive()

    def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a message."""
        data: Any = msgpack.packb(message, default=_pack)
        self._socket.send(data)
        return self._receive()

    def _receive(self) -> dict[str, Any]:
        answer = self._socket.recv()
        if isinstance(answer, str):
            sys.exit(f"the server says: {answer}")
        return msgpack.unpackb(answer, object_hook=_unpack, strict_map_key=False)


def make_world(task: str) -> Any:
    """Build a task with LeRobot's camera, whose episodes differ by the seed of their reset."""
    benchmark = metaworld.MT1(task, seed=42)
    world = benchmark.train_classes[task](render_mode="rgb_array", camera_name="corner2")
    world.set_task(benchmark.train_tasks[0])
    world.model.cam_pos[2] = [0.75, 0.075, 0.7]
    world.reset()
    world._freeze_rand_vec, world.seeded_rand_vec = False, True
    return world


def play(world: Any, server: Server, sentence: str, seed: int) -> bool:
    """Play an episode; return whether it succeeds."""
    world.seed(seed)
    values, _ = world.reset(seed=seed)
    server.ask({"reset": True, "prompt": sentence, "seed": seed})
    step = 0
    while step < STEPS:
        picture = np.ascontiguousarray(np.flip(world.render(), (0, 1)))
        request = {"observation/image": picture, "observation/state": values[:4].astype(np.float32), "prompt": sentence}
        for action in server.ask(request)["actions"][: server.about["execute"]]:
            values, _, _, _, info = world.step(np.clip(action * UNITS, -1, 1))
            step += 1
            if info["success"]:
                return True
            if step == STEPS:
                break
    return False


def main(seed: str, episodes: str, output: str, tasks: str = "", url: str = "ws://127.0.0.1:8000") -> None:
    """Play the episodes of every task, and write their successes after each."""
    conf = Path(__file__).parents[2] / "conf/task/metaworld.yaml"
    sentences = yaml.safe_load(conf.read_text(encoding="utf-8"))["sentences"]  # LeRobot's
    results = []
    Path(output).mkdir(parents=True, exist_ok=True)
    with connect(url, max_size=None, compression=None) as socket:
        server = Server(socket)
        for task in tasks.split(",") if tasks else sentences:
            world = make_world(f"{task}-v3")
            successes = [play(world, server, sentences[task], int(seed) + index) for index in range(int(episodes))]
            world.close()
            results.append({"task_group": f"{task}-v3", "metrics": {"successes": successes}})
            (Path(output) / "eval_info.json").write_text(json.dumps({"per_task": results}), encoding="utf-8")
            print(f"{task:28} {sum(successes)} of {episodes}", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
