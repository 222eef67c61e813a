"""Configurations that would act when they are built, if anything built them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

HANDLER = "torch.distributed.elastic.multiprocessing.subprocess_handler.subprocess_handler.SubprocessHandler"


def command(mark: Path) -> dict[str, Any]:
    """A node that runs a command when it is built."""
    arguments: dict[str, Any] = {
        "args": ["-c", f"id > {mark}"],
        "env": {},
        "stdout": None,
        "stderr": None,
        "local_rank_id": 0,
    }
    return {"_target_": HANDLER, "entrypoint": "/bin/sh", **arguments, "numa_options": None}


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
