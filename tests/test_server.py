"""A policy behind openpi's protocol, for well-behaved clients and for others."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import replace
from functools import partial
from itertools import cycle, takewhile
from pathlib import Path
from typing import Any, cast
from urllib.error import HTTPError
from urllib.request import urlopen

import msgpack
import numpy as np
import pytest
from command_line import SMALL, here
from composing import check, composed
from defaults import defaults_of
from fake_batch import as_policy, make_act, make_bc, make_denoising, make_rt1
from toy import SPEC, ToyEnvironment
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from vla.config.annotations import MissingLibrary, locate
from vla.config.experiment import Experiment
from vla.deploy.client_observation import Keys
from vla.deploy.server import PolicyServer, Service
from vla.io.array_messages import DTYPES, LARGEST_MAP, LONGEST_LIST, pack, unpack
from vla.models.chunking import TrainedPrefix
from vla.models.flow import Flow
from vla.models.model import Model
from vla.policy import Policy
from vla.rollouts.evaluate import play_episode
from vla.rollouts.remote import Component, RemotePolicy
from vla.rollouts.rollout import rollout
from vla.spec import FIRST_SEED, LONGEST_INSTRUCTION, Array, Observation, RunningPlan

TEXTS = ("go", "lift it now", "go", "put it down")
KEYS = Keys({"eye": "observation/image"}, ["observation/state"], "prompt")


def settings(policy: Policy, **changes: Any) -> PolicyServer:
    own = {"port": 0, "keys": KEYS, "connections": 4, "largest_message": 1_000_000, "api_key": None}
    parts: dict[str, Any] = {"policy": lambda: policy, "environment": ToyEnvironment, "output": Path()}
    return PolicyServer(**defaults_of("deploy/server", **{**own, **changes}), **parts)


def serving(policy: Policy, **changes: Any) -> AbstractContextManager[str]:
    """A server in a thread of its own, by its URL."""
    return Service(settings(policy, **changes), policy).serve_in_thread()


def client(url: str, **options: Any) -> ClientConnection:
    return connect(url, compression=None, max_size=None, proxy=None, **options)


def received(connection: ClientConnection) -> Any:
    data = connection.recv()
    assert isinstance(data, bytes), data
    return unpack(data)


def ask(connection: ClientConnection, content: Any) -> Any:
    """The answer to a message."""
    connection.send(pack(content))
    return received(connection)


def message(observation: Observation) -> dict[str, Any]:
    return {
        "observation/image": observation.rgb["eye"],
        "observation/state": observation.state,
        "prompt": observation.instruction,
    }


def observations(count: int, seed: int = 0) -> list[Observation]:
    random = np.random.default_rng(seed)
    return [SPEC.random_observation(random) for _ in range(count)]


def remote(url: str, **changes: Any) -> RemotePolicy:
    own = {"images": {"eye": "observation/image", "other": "observation/other"}, "timeout": 10.0, "api_key": None}
    return RemotePolicy(**defaults_of("agent/remote", url=url, **{**own, "spec": SPEC, **changes}))


@contextmanager
def acting(policy: Policy, **changes: Any) -> Iterator[RemotePolicy]:
    """A client, made with some changes, of a server with the policy."""
    with serving(policy) as url, closing(remote(url, **changes)) as agent:
        yield agent


def before_plans(policy: Policy, monkeypatch: pytest.MonkeyPatch, do: Callable[[int], object]) -> None:
    """Let the policy do something before it plans, given the number of observations so far."""
    plan, asked = policy.plan, list[Observation]()

    def planned(observations: Sequence[Observation], lanes: Sequence[int]) -> Array:
        asked.extend(observations)
        do(len(asked))
        return plan(observations, lanes)

    monkeypatch.setattr(policy, "plan", planned)


def test_a_client_gets_the_chunks_of_the_policy_and_anew_after_a_reset() -> None:
    policy, seen = as_policy(make_rt1()), observations(4)
    expected, anew = as_policy(policy.model), as_policy(policy.model).plan(seen[3])
    with serving(policy) as url, client(url) as connection:
        described = received(connection)
        for observation in seen:
            answer = ask(connection, message(observation))
            np.testing.assert_array_equal(answer["actions"], expected.plan(observation))
            assert answer["actions"].dtype == np.float32 and answer["server_timing"].keys() == {"infer_ms"}
        assert ask(connection, {"reset": True, "seed": 3, "prompt": "do what is to be done"}) == {"reset": True}
        np.testing.assert_array_equal(ask(connection, message(seen[3]))["actions"], anew)
    assert described["images"] == {"observation/image": [16, 16, 3]} and described["prompt"] == "prompt"
    assert described["action"]["names"] == list(SPEC.action) and described["history"] == policy.model.history
    np.testing.assert_array_equal(described["action"]["high"], np.array(SPEC.high, np.float32))


def test_a_slow_server_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, gate, seen = as_policy(make_bc(chunk=3)), threading.Event(), observations(60)
    with acting(policy, asynchronous=True, execute=1, spec=replace(SPEC, control_hz=200.0)) as agent:
        before_plans(policy, monkeypatch, lambda number: number == 1 or gate.wait(30))
        agent.reset(seen[0].instruction, 0)
        first = as_policy(policy.model).plan(seen[0])
        actions = [agent.act(observation) for observation in seen[:5]]
        np.testing.assert_array_equal(actions[:3], first)  # though the server does not answer any more
        held = np.where([True, True, False], 0, first[2])
        np.testing.assert_array_equal(actions[3:], [held, held])
        gate.set()
        end = time.monotonic() + 60
        more = takewhile(lambda _: time.monotonic() < end, cycle(seen[5:]))
        later = next(action for each in more if not np.array_equal(action := agent.act(each), held))
        # The second observation was sent at step 1; two actions followed, the third of its chunk is due.
        np.testing.assert_array_equal(later, as_policy(policy.model).plan(seen[1])[2])
        agent.reset(seen[0].instruction, 0)  # whatever is awaited is dropped
        np.testing.assert_array_equal(agent.act(seen[0]), first[0])


@pytest.mark.parametrize("make", [make_bc, make_rt1, make_act, partial(make_denoising, Flow)])
@pytest.mark.parametrize("rows", [1, 3])
def test_clients_act_as_if_they_were_alone_bit_for_bit(make: Callable[[], Model], rows: int) -> None:
    policy = as_policy(make(), lanes=rows)
    streams = [[replace(each, instruction=text) for each in observations(3, seed)] for seed, text in enumerate(TEXTS)]

    def talk(seed: int) -> list[Array]:
        with client(url) as connection:
            connection.recv()
            ask(connection, {"reset": True, "seed": seed, "prompt": TEXTS[seed]})
            return [ask(connection, message(each))["actions"] for each in streams[seed]]

    with serving(policy) as url, ThreadPoolExecutor(len(TEXTS)) as threads:
        results = [*threads.map(talk, range(len(TEXTS)))]
    for seed, stream in enumerate(streams):
        alone = as_policy(policy.model, lanes=rows)
        alone.reset(TEXTS[seed], seed)
        np.testing.assert_array_equal(results[seed], [alone.plan(each) for each in stream])


def test_a_plan_goes_on_from_the_one_that_a_client_executes() -> None:
    model = make_denoising(Flow, chunk=8, execute=2, prefix=4)
    policy, seen = as_policy(model, chunking=TrainedPrefix()), observations(5)
    expected, plans = as_policy(model, chunking=TrainedPrefix()), list[Array]()
    with acting(policy) as agent:
        assert agent.metadata["chunking"] is True and agent.execute == 2  # before the first plan
        agent.reset(seen[0].instruction, 0)
        acted = [agent.act(observation) for observation in seen]
        for number in (0, 2, 4):  # without delay nothing is certain, and two actions of each plan are executed
            running = RunningPlan(plans[-1][2:], 0) if plans else None
            plans.append(expected.plan(replace(seen[number], running=running)))
        np.testing.assert_array_equal(acted, [*plans[0][:2], *plans[1][:2], plans[2][0]])
        late = replace(seen[0], running=RunningPlan(plans[2][1:], 3))
        np.testing.assert_array_equal(agent.plan(late)[:3], plans[2][1:4])
        mapped = {name: Component(index, 1.0, 0.0) for index, name in enumerate(SPEC.action)}
        with closing(remote(agent.url, actions=mapped)) as other:
            assert "running" not in other.message(late)
    with acting(as_policy(make_bc())) as agent:
        assert agent.metadata["chunking"] is False and "running" not in agent.message(late)


@pytest.mark.parametrize(
    ("running", "sentence"),
    [
        ([], r"running/actions must be a plan \(n, 3\), got None"),
        ({"actions": np.zeros((2, 2), np.float32), "delay": 0}, r"running/actions must be a plan \(n, 3\)"),
        ({"actions": np.zeros((0, 3), np.float32), "delay": 0}, r"\(n, 3\), got \(0, 3\)"),
        ({"actions": np.full((2, 3), np.nan, np.float32), "delay": 0}, "running/actions holds a number that is not"),
        ({"actions": np.zeros((2, 3), np.float32), "delay": 3}, "running/delay is 3, expected an integer from 0 to 2"),
        ({"actions": np.zeros((2, 3), np.float32), "delay": True}, "running/delay is True"),
    ],
)
def test_a_plan_that_is_none_is_refused(running: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        KEYS.observation({**message(observations(1)[0]), "running": running}, SPEC)


def test_images_of_other_sizes_kinds_and_places_are_taken() -> None:
    observation = observations(1)[0]
    image = observation.rgb["eye"]
    plain = KEYS.observation(message(observation), SPEC)
    np.testing.assert_array_equal(plain.rgb["eye"], image)
    nested = {
        "observation": {"image": image.transpose(2, 0, 1) / np.float32(255), "state": list(map(float, plain.state))}
    }
    other = KEYS.observation({**nested, "prompt": "go"}, SPEC)
    np.testing.assert_array_equal(other.rgb["eye"], image)
    np.testing.assert_array_equal(other.state, plain.state)
    large = {**message(observation), "observation/image": image.repeat(4, 0).repeat(6, 1)}
    assert KEYS.observation(large, SPEC).rgb["eye"].shape == (64, 96, 3)
    named = replace(KEYS, images={}).observation({**message(observation), "eye": image}, SPEC)  # without a key
    np.testing.assert_array_equal(named.rgb["eye"], image)
    parts = Keys(KEYS.images, ["east", "north"], "prompt")
    split = {"observation/image": image, "east": np.float32(1), "north": [2.0], "prompt": "go"}
    np.testing.assert_array_equal(parts.observation(split, SPEC).state, [1, 2])


def test_the_encoding_is_documented() -> None:
    page = (Path(__file__).parents[1] / "docs/serving.md").read_text()
    assert all(f'"{name}"' in page for name in DTYPES)
    image = {b"__ndarray__": True, b"data": bytes(range(12)), b"dtype": "|u1", b"shape": [1, 4, 3]}
    seed = {b"__npgeneric__": True, b"data": 5, b"dtype": "<i8"}
    given = unpack(bytes(msgpack.packb({"image": image, "seed": seed}) or b""))
    assert given["seed"] == 5 and given["image"].tolist() == [[[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]]]


@pytest.mark.parametrize(
    ("library", "extra", "target"),
    [
        ("msgpack", "server", "vla.deploy.server.PolicyServer"),
        ("websockets", "server", "vla.rollouts.remote.RemotePolicy"),
        ("transformers", "vlm", "vla.models.vlm.smolvla.SmolVLA"),
        ("onnxruntime", "onnx", "vla.deploy.onnx_policy.OnnxPolicy"),
        ("onnxscript", "onnx", "vla.deploy.onnx_policy.OnnxPolicy"),
        ("metaworld", "metaworld", "vla.tasks.metaworld.environment.MetaWorld"),
    ],
)
def test_what_is_missing_is_said_with_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, library: str, extra: str, target: str
) -> None:
    users = ("vla.io.array_messages", "vla.tasks.metaworld.package", target.rpartition(".")[0])
    for module in [*sys.modules]:
        if module in users or module.startswith(f"{library}."):
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingLibrary, match=rf"{library}.* its extra {extra}: pip install -e '\.\[{extra}\]'"):
        locate("here", target)


def test_scalars_of_numpy_are_numbers() -> None:
    for scalar in (np.int64(5), np.uint8(5), np.array(5)):
        assert type(unpack(pack({"seed": scalar}))["seed"]) is int
    assert unpack(pack([np.float32(0.1), np.bool_(True), np.array(2.0)])) == [np.float32(0.1), True, 2.0]
    policy = as_policy(make_bc())
    seen = {**message(observations(1)[0]), "observation/state": [np.float32(0.5), np.int8(1)]}
    with serving(policy) as url, client(url) as connection:
        connection.recv()
        assert ask(connection, {"reset": np.bool_(True), "prompt": "go", "seed": np.int64(5)}) == {"reset": True}
        assert ask(connection, seen)["actions"].dtype == np.float32


WHOLE = message(observations(1)[0])
WRONG: dict[str, tuple[Any, str]] = {
    "text": ("hello", "must be a binary message in msgpack, got text"),
    "noise": (b"\xc1\x00", "cannot be read as msgpack with arrays of numbers"),
    "half": (pack(WHOLE)[:100], "cannot be read as msgpack"),
    "list": (pack([1, 2]), "an observation must be a map, got list"),
    "empty": (pack({}), "lacks observation/image, observation/state, prompt: it has nothing"),
    "keys": (pack({"image": 1, "prompt": "go"}), "lacks observation/image, observation/state: it has image, prompt"),
    "image": (
        pack({**WHOLE, "observation/image": np.zeros((4, 4), np.uint8)}),
        r"must be an image \(H, W, 3\).*\(4, 4\)",
    ),
    "range": (pack({**WHOLE, "observation/image": np.full((4, 4, 3), 255.0)}), "send uint8, or floats from 0 to 1"),
    "state": (pack({**WHOLE, "observation/state": np.zeros(3)}), "has 3 numbers, the policy needs 2: east, north"),
    "finite": (pack({**WHOLE, "observation/state": [np.nan, 0.0]}), "holds a number that is not finite"),
    "words": (pack({**WHOLE, "observation/state": "far"}), "observation/state is not a vector of numbers"),
    "rows": (pack({**WHOLE, "observation/state": [[1.0], [1.0, 2.0]]}), "observation/state is not a vector of numbers"),
    "prompt": (
        pack({**WHOLE, "prompt": "a" * (LONGEST_INSTRUCTION + 1)}),
        "has 1001 characters, an instruction at most",
    ),
    "prompts": (pack({**WHOLE, "prompt": ["go"]}), "prompt must be an instruction, a text, got list"),
    "seed": (pack({"reset": True, "seed": -1}), "seed is -1, expected an integer"),
    "half a seed": (pack({"reset": True, "prompt": "go", "seed": np.float32(0.5)}), "seed is 0.5, expected an integer"),
    "escapes": (pack({"\x1b]0;evil\x07\nerror: none": 1}), "the observation lacks"),
    "objects": (
        msgpack.packb({b"__ndarray__": True, b"dtype": "|O", b"data": b"cos\nsystem\n", b"shape": [1]}),
        r"has the type \|O, expected one of",
    ),
    "short": (
        msgpack.packb({b"__ndarray__": True, b"dtype": "<f8", b"data": b"", b"shape": [10**9, 10**9]}),
        "has too many or too few bytes",
    ),
    "reset without a prompt": (pack({"reset": True, "seed": 7}), "prompt must be an instruction"),
    "deep": (b"\x91" * 100_000 + b"\x01", "cannot be read as msgpack"),
    "lists": (msgpack.packb([[0] * 1000] * (LONGEST_LIST // 1000)), "hold more than 10000 items"),
    "maps": (msgpack.packb([{}] * (LARGEST_MAP + 1)), "more than 1000 maps"),
}


def test_who_sends_nonsense_is_told_why_and_disturbs_nobody(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("vla.deploy.server.WARNINGS", 3)  # which do not fill the disk
    policy = as_policy(make_bc())
    expected = as_policy(policy.model).plan(observations(1)[0])
    with serving(policy) as url, client(url) as good:
        good.recv()
        for data, sentence in WRONG.values():
            with client(url) as bad:
                bad.recv()
                bad.send(data)
                said = bad.recv()
                assert isinstance(said, str) and re.search(sentence, said), said
                with pytest.raises(ConnectionClosed):
                    bad.recv()
        with client(url) as large:
            large.recv()
            large.send(pack({"observation/image": np.zeros(2_000_000, np.uint8)}))
            with pytest.raises(ConnectionClosed, match="1009"):
                large.recv()
        np.testing.assert_array_equal(ask(good, WHOLE)["actions"], expected)
    assert [each.partition(" at ")[0] for each in caplog.messages] == ["refused a client"] * 3


def test_only_so_many_come_in_and_only_with_the_key() -> None:
    policy = as_policy(make_bc())
    key = {"additional_headers": {"Authorization": "Api-Key open"}}
    with serving(policy, api_key="open", connections=1) as url:
        http = url.replace("ws://", "http://")
        assert urlopen(f"{http}/healthz").read() == b"OK\n"
        with pytest.raises(HTTPError, match="401"):
            urlopen(http)
        with pytest.raises(InvalidStatus, match="401"):
            client(url)
        before = threading.active_count()
        with pytest.raises(ValueError, match="failed: send the API key as Authorization: Api-Key"):
            remote(url)
        assert threading.active_count() <= before
        with client(url, **key) as connection:
            connection.recv()
            with pytest.raises(ValueError, match=r"failed: no room beside 1 client: raise deploy\.connections"):
                remote(url, api_key="open")
        remote(url, api_key="open").close()


def test_web_pages_come_in_only_from_where_they_may() -> None:
    with serving(as_policy(make_bc()), origins=["http://localhost:3000"]) as url:
        for origin in ("http://evil.example", "null", "http://localhost:3000.evil.example"):
            with pytest.raises(InvalidStatus, match="403"):
                client(url, additional_headers={"Origin": origin})
        with client(url, additional_headers={"Origin": "http://localhost:3000"}) as page:
            assert received(page)["server"] == "vla"


def test_what_cannot_be_served_is_said_in_a_sentence() -> None:
    policy, unloaded = as_policy(make_bc()), cast(Any, None)
    with pytest.raises(ValueError, match=r"deploy\.host=0\.0\.0\.0 lets other machines use the policy: set"):
        settings(policy, host="0.0.0.0")
    assert settings(policy, host="0.0.0.0", api_key="open").host == "0.0.0.0"
    with serving(policy) as url:
        client: Any = remote(url)
        with pytest.raises(
            ValueError, match=r"deploy=server serves a trained policy, .* a RemotePolicy cannot be served"
        ):
            settings(client).run()
        client.close()
        port = int(url.rpartition(":")[2])
        with pytest.raises(
            ValueError, match=rf"cannot listen at deploy\.host=127\.0\.0\.1 deploy\.port={port}: .*in use"
        ):
            replace(settings(policy, port=port), policy=unloaded).run()  # said before a policy is loaded


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_told_to_stop(number: signal.Signals, caplog: pytest.LogCaptureFixture) -> None:
    asked = []

    def stop() -> None:
        deadline = time.monotonic() + 60
        while not caplog.messages and time.monotonic() < deadline:
            time.sleep(0.01)
        url = caplog.messages[0].removeprefix("serving the policy at ").replace("ws://", "http://")
        asked.append(urlopen(f"{url}/healthz").read())
        os.kill(os.getpid(), number)

    with caplog.at_level(logging.INFO, "vla.deploy.server"):
        thread = threading.Thread(target=stop, daemon=True)
        thread.start()
        settings(as_policy(make_bc())).run()
        thread.join(60)
    assert asked == [b"OK\n"]


def test_a_client_needs_no_images_of_steps_at_which_it_sends_nothing() -> None:
    with acting(as_policy(make_act(chunk=4, execute=2))) as agent:
        every, some = (rollout(ToyEnvironment(), agent, FIRST_SEED, all_images=complete) for complete in (True, False))
    assert np.array_equal(every.executed, some.executed)
    assert [step for step, seen in enumerate(some.observations) if seen.rgb] == [*range(0, len(some.observations), 2)]


def test_somebody_elses_actions_become_ours() -> None:
    policy = as_policy(make_bc())
    swapped = {"x": Component(1, 1.0, 0.0), "y": Component(0, -1.0, 0.0), "gripper": Component(2, 1.0, 2.0)}
    observation = observations(1)[0]
    x, y, _ = as_policy(policy.model).plan(observation)[0]
    with serving(policy) as url:
        agent = remote(url, actions=swapped)
        agent.reset(observation.instruction, 0)
        np.testing.assert_allclose(agent.act(observation), [y, -x, 1.0])
        with pytest.raises(ValueError, match=r"agent\.actions must map x, y, gripper, got x"):
            remote(url, actions={"x": Component(0, 1.0, 0.0)})
        with pytest.raises(ValueError, match=r"no key for the world's cameras, eye: add \+agent\.images\.eye=KEY"):
            remote(url, images={"back": "observation/image", "eye": None})
        with pytest.raises(ValueError, match="failed: its actions have 3 components"):
            remote(url, actions={**swapped, "x": Component(3, 1.0, 0.0)}).act(observation)


def test_images_are_sent_first_by_channel_and_in_maps_within_maps() -> None:
    policy, observation = as_policy(make_bc()), observations(1)[0]
    expected = as_policy(policy.model).plan(observation)
    with acting(policy, images={"eye": ["observation", "image"]}, channels_first=True) as agent:
        sent = agent.message(observation)
        np.testing.assert_array_equal(sent["observation"]["image"], observation.rgb["eye"].transpose(2, 0, 1))
        agent.reset(observation.instruction, 0)
        np.testing.assert_array_equal(agent.plan(observation), expected)


def test_a_server_with_other_components_or_another_rate_is_noticed(caplog: pytest.LogCaptureFixture) -> None:
    policy, observation = as_policy(make_bc()), observations(1)[0]
    slower = replace(SPEC, action=("y", "x", "gripper"), control_hz=7.0)
    with serving(policy) as url:
        threads = threading.active_count()
        with pytest.raises(
            ValueError, match=r"its actions are x, y, gripper, the world's y, x, gripper: set agent\.act"
        ):
            remote(url, spec=slower)
        assert threading.active_count() <= threads
        remote(url, spec=replace(SPEC, control_hz=7.0)).close()
        two = replace(SPEC, action=("x", "y"), low=SPEC.low[:2], high=SPEC.high[:2], units=SPEC.units[:2])
        fewer = remote(url, actions={"x": Component(0, 1.0, 0.0), "y": Component(1, 1.0, 0.0)}, spec=two)
        fewer.actions = None
        with pytest.raises(ValueError, match=r"its actions have 3 components, the world's x, y: set agent\.actions"):
            fewer.plan(observation)
        fewer.close()
        large = {name: Component(index, 100.0, 5.0) for index, name in enumerate(SPEC.action)}
        scaled = remote(url, actions=large)
        for _ in range(2):
            scaled.plan(observation)
        scaled.close()
    assert (
        caplog.text.count(
            "are far beyond the bounds of the world, to which they are clipped: convert their units with agent.act"
        )
        == 1
    )
    assert f"acts at {SPEC.control_hz:g} Hz, the world at 7 Hz" in caplog.text


def test_a_late_answer_is_not_taken_for_that_of_the_next_observation(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, gate, seen = as_policy(make_bc()), threading.Event(), observations(4)
    with acting(policy) as agent:
        before_plans(policy, monkeypatch, lambda number: number != 2 or gate.wait(30))
        agent.act(seen[0])
        agent._connection.timeout = 0.1
        with pytest.raises(ValueError, match=r"no answer within 0\.1 s"):
            agent.act(seen[1])
        gate.set()
        agent._connection.timeout = 30.0
        with pytest.raises(ValueError, match="closed the connection"):
            agent.act(seen[2])  # within the same episode it stays that way
        agent.reset(seen[3].instruction, 1)
        np.testing.assert_array_equal(agent.act(seen[3]), as_policy(policy.model).plan(seen[3])[0])


def test_a_server_that_fails_or_goes_away_costs_an_episode_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, seen = as_policy(make_bc()), observations(2)

    def fail(number: int) -> None:
        if number == 1:
            raise RuntimeError("no idea")

    with serving(policy) as url:
        before_plans(policy, monkeypatch, fail)
        agent = remote(url)
        with pytest.raises(ValueError, match=r"the policy server at .* failed"):
            agent.act(seen[0])
        agent.reset(seen[1].instruction, 1)
        np.testing.assert_array_equal(agent.act(seen[1]), as_policy(policy.model).plan(seen[1])[0])
        assert play_episode(ToyEnvironment(), agent, FIRST_SEED).outcome in ("success", "timeout")
    failed = play_episode(ToyEnvironment(), agent, FIRST_SEED)
    assert failed.outcome == "error" and f"the policy server at {url} failed: it closed the connection" in failed.error
    with pytest.raises(ValueError, match=f"no policy server at {url} .*: start it"):
        remote(url)


def test_another_policy_after_a_restart_is_noticed() -> None:
    one_frame, history = as_policy(make_bc()), as_policy(make_rt1())
    seen = observations(1)[0]
    with serving(one_frame) as url:
        agent = remote(url)
        agent.reset(seen.instruction, 0)
        agent.act(seen)
    with pytest.raises(ValueError, match="it closed the connection"):
        agent.plan(seen)
    with serving(history) as agent._connection.url:
        agent.reset(seen.instruction, 1)
        assert (agent.metadata["history"], agent.history) == (history.model.history, history.model.history)
        assert agent.metadata["execute"] == 1  # which needs every observation
        np.testing.assert_array_equal(agent.act(seen), as_policy(history.model).plan(seen)[0])
        agent.close()


def test_an_address_is_reached_directly_whatever_proxy_the_environment_names(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "ws_proxy", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    with serving(as_policy(make_bc())) as url:
        remote(url.replace("127.0.0.1", "localhost")).close()


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("ws://127.0.0.1:99999", "Port out of range 0-65535"),
        ("127.0.0.1:8000", "scheme isn't ws or wss"),
    ],
)
def test_what_is_no_address_is_said_to_be_none(url: str, why: str) -> None:
    with pytest.raises(ValueError, match=rf"^agent\.url=.* leads to no policy server \(.*{why}.*give one like ws://"):
        remote(url)


def test_a_key_and_images_go_to_the_named_server_only() -> None:
    asked: list[str] = []

    def elsewhere(connection: ServerConnection, request: Request) -> Response:
        asked.append(request.headers.get("Authorization", "no key"))
        return Response(302, "Found", Headers({"Location": other, "Content-Length": "0"}))

    with (
        serving(as_policy(make_bc())) as other,
        serve(lambda _: None, "127.0.0.1", 0, process_request=elsewhere) as named,
    ):
        threading.Thread(target=named.serve_forever, daemon=True).start()
        url = f"ws://127.0.0.1:{named.socket.getsockname()[1]}"
        with pytest.raises(ValueError, match=rf"agent\.url={url} leads to no policy server \(cannot follow .*{other}"):
            remote(url, api_key="s3cret")
    assert asked == ["Api-Key s3cret"]


def test_whoever_acts_is_evaluated_by_the_same_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLA_API_KEY", "s3cret")
    common = (*SMALL, "evaluate.episodes=1", "task.time_limit=1", "recorder=none")
    environment = Experiment.from_config(composed(*common)).make_environment()()
    policy = as_policy(make_bc(spec=environment.spec), spec=environment.spec)
    expected = play_episode(environment, as_policy(policy.model, spec=environment.spec), FIRST_SEED)
    environment.close()
    keys = Keys({"front": "observation/image", "wrist": "observation/wrist_image"}, ["observation/state"], "prompt")
    with serving(policy, keys=keys, api_key="s3cret", connections=1) as url:  # each condition closes its own
        network = "{_target_: vla.rollouts.realtime.Network, latency: 0.1, jitter: 0, loss: 0, ensemble: null}"
        conditions = (
            "evaluate.without=[images]",
            f"+evaluate.networks.near={network}",
            "+evaluate.conditions.dark={shadows: true}",
        )
        here(tmp_path, "agent=remote", f"agent.url={url}", *common, *conditions, "output=remote")
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and b"s3cret" in path.read_bytes()]
    report = json.loads((tmp_path / "remote/report.json").read_text())
    (played,) = report["per_episode"]
    assert (played["outcome"], played["steps"], played["draws"]) == (expected.outcome, 10, expected.draws)
    assert (report["model"], report["checkpoint"], report["errors"]) == ("remote", None, 0)
    assert {*report["conditions"]} == {"without_images", "near", "dark"}
    here(tmp_path, "agent=expert", *common, "task.time_limit=10", "output=expert")
    report = json.loads((tmp_path / "expert/report.json").read_text())
    assert (report["model"], report["successes"]) == ("expert", 1)
    assert "<h1>expert · pick place</h1>" in (tmp_path / "expert/report.html").read_text()
    with pytest.raises(ValueError, match=r"^job=train takes no agent: agent=OPTION goes with job=evaluate"):
        check(composed("agent=expert", "job=train"))
