"""Configurations, policies and checkpoints of nobody here: what they hold once acted when it was read or built."""

from __future__ import annotations

import socket
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from composing import composed, run_job
from saved_policies import save_policy
from toy import SPEC

from vla.config.adopt import adopt, finetune
from vla.config.build import build
from vla.config.experiment import make_policy, to_plain

HANDLER = "torch.distributed.elastic.multiprocessing.subprocess_handler.subprocess_handler.SubprocessHandler"


def command(mark: Path) -> dict[str, Any]:
    """A node that runs a command when it is built."""
    shell: dict[str, Any] = {"entrypoint": "/bin/sh", "args": ["-c", f"id > {mark}"], "env": {}, "local_rank_id": 0}
    return node(HANDLER, **shell, stdout=None, stderr=None, numa_options=None)


def put(config: dict[str, Any], key: str, value: Any) -> None:
    """Set what stands at a key with dots."""
    *parents, name = key.split(".")
    for parent in parents:
        config = config[parent]
    config[name] = value


def node(target: str, **arguments: Any) -> dict[str, Any]:
    return {"_target_": target, **arguments}


def hostile(mark: Path) -> dict[str, tuple[str, Any]]:
    """Attack → the key of a configuration, and what it holds; each of them once acted, mostly by leaving `mark`."""
    created = "${oc.select:model.text,${oc.create:{_target_:%s}}}"
    return {
        **{f"a command as {key}": (key, command(mark)) for key in ("model.image", "model.text", "task.goal")},
        "a command as an axis": ("task.randomize.mass", command(mark)),
        "a command as a plugin": ("trainer.plugins", [command(mark)]),
        "a file emptied": ("model.image", node("torch.serialization._open_file", name=str(mark), mode="w")),
        "code behind a reference": (
            "model.image",
            created % f"torch._inductor.codecache.PyCodeCache.load,_args_:[\"open({str(mark)!r},'w')\"]",
        ),
        "a log behind a reference": ("model.image", created % f"logging.FileHandler,filename:{mark}"),
        "an array behind a reference": ("model.image", created % f"numpy.savetxt,fname:{mark},X:[1]"),
        "the environment": ("chosen.experiment", "${oc.env:PATH}"),
        "the working folder": ("task.goal.language.phrasings", ["take {block} ${hydra:runtime.cwd}"]),
    }


class Hiding:
    """A mapping whose methods are those that the file says, as PyTorch's reader makes it."""

    def __init__(self, shown: dict[str, Any], *methods: str) -> None:
        self._shown, self._hidden = shown, dict.fromkeys(methods, OrderedDict)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as an OrderedDict with attributes."""
        return OrderedDict, (), self._hidden, None, iter(self._shown.items())


def python(mark: Path) -> dict[str, Any]:
    """A node that runs Python when it is built."""
    return node("torch._inductor.codecache.PyCodeCache.load", _args_=[f"open({str(mark)!r}, 'w')"])


def remote(port: int, key: str | None = None) -> dict[str, Any]:
    """An agent that connects with this port."""
    return to_plain(composed("agent=remote"))["agent"] | {
        "url": f"ws://127.0.0.1:{port}",
        "api_key": key,
        "timeout": 1.0,
    }


def recorded() -> dict[str, Any]:
    """A world of recordings, as a policy describes it."""
    names: dict[str, Any] = {"cameras": ["front"], "state": ["a", "b"], "action": ["a", "b"], "low": [-1.0, -1.0]}
    further = {"image_size": [16, 16], "control_hz": 5.0, "units": "1", "high": [1.0, 1.0], "joints": None}
    return node("vla.tasks.recorded.Recorded", **names, **further)


def hiding(config: dict[str, Any], mark: Path, port: int) -> dict[str, Any]:
    """Attack → the configuration of a policy that ran code, or connected with a port, when it was used."""
    perturbed = config["expert"] | {"expert": remote(port) | {"_partial_": True}}
    secret = {**config, "task": recorded(), "expert": remote(port, "${oc.env:ATTACK_SECRET}")}
    return {
        "python in a number": {**config, "tokenizer": config["tokenizer"] | {"bins": python(mark)}},
        "python in a list": {**config, "model": {**config["model"], "image": [python(mark)]}},
        "python in a key of its own": {**config, "model": {**config["model"], "more": python(mark)}},
        "a secret for a stranger": secret,
        "a secret in the report": {**config, "chosen": {"experiment": "${oc.env:ATTACK_SECRET}"}},
        "a connection of a recording": {**config, "task": recorded(), "expert": remote(port)},
        "a connection of an expert": {**config, "expert": remote(port)},
        "a connection within an expert": {**config, "expert": perturbed},
    }


def hidden(config: dict[str, Any], mark: Path) -> dict[str, Any]:
    """Attack → the configuration of a checkpoint, whose pickle can hide what a mapping holds."""
    methods = ("items", "values", "keys", "get", "__class__", "__iter__", "copy")
    bins = config["tokenizer"] | {"bins": python(mark)}
    return {
        "python in a mapping that hides it": {**config, "tokenizer": Hiding(bins, "items", "values")},
        "python in a mapping without methods": {**config, "tokenizer": Hiding(bins, *methods)},
        "python in the mapping of all": Hiding({**config, "tokenizer": Hiding(bins, *methods)}, *methods),
        "a key that is no text": {**config, "model": {**config["model"], 5: 1}},
        "keys that are no text": {**config, "model": {True: 1, float("nan"): 2}},
    }


def save(folder: Path, config: Any) -> Path:
    """Write a policy without weights of the world that its configuration describes."""
    known = config["task"] == recorded()
    return save_policy(folder, config, build(config["task"], "task").spec if known else SPEC)


def ways(policy: Path, *own: str) -> dict[str, Callable[[], object]]:
    """How somebody else's policy is used, with overrides of one's own."""

    def adopted(*options: str) -> Callable[[], None]:
        return lambda: run_job(adopt(composed(*own, f"checkpoint={policy}", *options), []))

    def tuned(job: str) -> Callable[[], None]:
        return lambda: run_job(finetune(composed(*own, f"pretrained={policy}", f"job={job}"), []))

    return {
        "policy": lambda: make_policy(to_plain(composed().policy), policy),  # as programs do
        **{"evaluate": adopted(), "deploy": adopted("job=deploy", "deploy=ros2")},
        **{"pretrained": tuned("train"), "improve": tuned("improve")},
    }


@contextmanager
def listener() -> Iterator[tuple[int, Callable[[], bool]]]:
    """A port of this machine, and whether somebody has connected with it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)

        def connected() -> bool:
            try:
                server.accept()[0].close()
            except BlockingIOError:
                return False
            return True

        yield server.getsockname()[1], connected
