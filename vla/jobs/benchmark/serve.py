"""Latency of a policy over a network, on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from threading import Thread

import numpy as np

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.deploy.client_observation import Keys
from vla.deploy.server import PolicyServer, Service
from vla.io.array_messages import pack
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.policy import Policy
from vla.rollouts.remote import RemotePolicy


def measures(experiment: Experiment) -> dict[str, Measure]:
    """Measure the time from an observation to its chunk through the loopback interface, in turns with its floors.

    - serve: median, and 99th percentile, of round trips; the floor is the policy called in its own process.
    - serve: transport: median round trip of the same bytes without inference; the floor is a bare WebSocket that
      echoes them.

    Raises:
        UserError: no checkpoint is given.
    """
    policy, steps = experiment.make_policy()(), experiment.options(Benchmark).steps
    random = np.random.default_rng(0)
    observations = [policy.spec.random_observation(random) for _ in range(steps)]
    with _serving(experiment, policy) as agent, _echo() as echo:
        plans, trips, waits, echoes = [], [], [], []
        for observation in observations:
            plans.append(timed(partial(policy.plan, [observation], [1]))[1])
            answer, seconds = timed(partial(agent.ask, observation))
            trips.append(seconds)
            waits.append(seconds - answer["server_timing"]["infer_ms"] / 1000)
            echoes.append(timed(partial(echo, pack(agent.message(observation))))[1])
        agent.close()
    (plan, slow_plan), (trip, slow_trip) = (1000 * np.percentile(each, [50, 99]) for each in (plans, trips))
    wait, bare = (1000 * float(np.median(each)) for each in (waits, echoes))
    return {
        "serve": measure(float(trip), "ms", steps, float(plan)),
        "serve: 99th percentile": measure(float(slow_trip), "ms", steps, float(slow_plan)),
        "serve: transport": measure(wait, "ms", steps, bare),
    }


@contextmanager
def _serving(experiment: Experiment, policy: Policy) -> Iterator[RemotePolicy]:
    """A server of the policy with the keys of this project, and its client."""
    cameras = {camera: f"observation.images.{camera}" for camera in policy.spec.cameras}
    keys = Keys(cameras, ["observation.state"], "task")
    server = PolicyServer(
        host="127.0.0.1",
        port=0,
        keys=keys,
        image_crop="centre",
        connections=1,
        largest_message=2**26,
        api_key=None,
        origins=[],
        certificate=None,
        private_key=None,
        policy=lambda: policy,
        environment=experiment.make_environment(),
        output=experiment.output,
    )
    with Service(server, policy).in_thread() as url:
        yield RemotePolicy(
            url=url,
            images=dict(cameras),
            channels_first=False,
            image_size=None,
            state={keys.state[0]: None},
            prompt=keys.prompt,
            actions=None,
            execute=None,
            asynchronous=False,
            ensemble=None,
            timeout=60.0,
            api_key=None,
            spec=policy.spec,
        )


@contextmanager
def _echo() -> Iterator[Callable[[bytes], object]]:
    """A WebSocket that sends back the first kilobyte of what it gets, as long as a chunk of actions."""
    from websockets.sync.client import connect
    from websockets.sync.server import ServerConnection, serve

    def answer(connection: ServerConnection) -> None:
        for message in connection:
            connection.send(message[:1000])

    with serve(answer, "127.0.0.1", 0, compression=None, max_size=2**26) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        address = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        with connect(address, compression=None, max_size=2**26, proxy=None) as connection:

            def echo(data: bytes) -> object:
                connection.send(data)
                return connection.recv()

            yield echo
        server.shutdown()
        thread.join()
