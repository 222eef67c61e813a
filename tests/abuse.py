"""Attacks in bulk, for docs/results/safety.md: `python tests/abuse.py FOLDER [commands|checkpoints:2|kills …]`.

Every trial is a command in a process of its own, in a folder that is made. A trial holds when the command ends in time,
and either succeeds or says in one line what is wrong, and when nothing that a file asked for was done.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from abuse_files import bags, datasets, runs
from abuse_kills import kills
from abuse_messages import messages
from hostile import hiding, hostile, listener, put, save
from saved_policies import save_run
from trials import CHECKPOINT, EVALUATE, TRAIN, Trials, last, run

# Command lines beside those of `test_bad_input`: what is common to some → what each of them ends with.
WRONG = {
    "": """
        job=colect model.widht=3 task/goal=lfit checkpoint=last seed= = a=b model.image.kernels=[3] trainer.devices=99
        data.batch_size=10000000 checkpoint=STORE evaluate.seed=0 pretrained=nowhere.ckpt expert=lerobot logger=wandb
        logger=mlflow tokenizer=fast trainer.accelerator=gpu trainer=fsdp trainer.precision=8
    """,
    "job=collect": """
        task.randomize.mass.factor=[-1,-1] task.goal.language.phrasings=['{nope}'] task.goal.language.phrasings=['{']
        task.goal.language.phrasings=['{0.__class__}'] task.cameras=[top]
    """,
    "job=report": """
        report.runs=[DAMAGED/list] report.runs=[DAMAGED/config] report.runs=[DAMAGED/training]
        report.runs=[DAMAGED/metrics] report.runs=[DAMAGED/loop] report.runs=[DAMAGED/empty] report.runs=[DAMAGED/bomb]
    """,
    "checkpoint=CKPT": "resume=true job=train model.width=3 policy.device=cuda task.control_hz=3",
    "job=deploy": "deploy=ros2",
    "job=deploy deploy=ros2 checkpoint=CKPT": "deploy.topics.commands=bad!topic deploy.network.domain=9999",
    "job=deploy deploy=ros2 checkpoint=CKPT --ros-args": "--nonsense",
    "job=deploy deploy=loop checkpoint=CKPT": "deploy.episodes=0",
    "job=inspect": "inspect.folder=nowhere",
    "job=inspect inspect.stores=[]": "inspect.into=x",
    "job=export": "export=program",
    "expert=lerobot": "expert.folder=.",
    "validate.episodes=1": "validate.seed=1000000",
}
# `store.json` and lines of an index that no collection writes: where, and what stands there.
HEADERS: tuple[tuple[str, Any], ...] = (
    *((f"spec.{name}", 5) for name in ("cameras", "action", "state", "state_units", "units", "low", "image_size")),
    *(("spec", 3), ("spec.image_size", [-1, -1]), ("spec.image_size", ["a", "b"]), ("spec.action", [])),
    *(("spec.control_hz", 0), ("spec.control_hz", "x"), ("codec", None), ("codec", "x"), ("config", None)),
    *(("config", [1]), ("config", {"parts": None}), ("format", 0), ("format", 2), ("format", None)),
    *(("config", {"task": {"_target_": "os.system"}}), ("config", {"task": "${oc.env:PATH}"})),
)


def prepared(root: Path) -> None:
    """A store, a trained checkpoint, and damaged runs in `root`."""
    if not (root / CHECKPOINT).exists():
        root.mkdir(parents=True, exist_ok=True)
        how, printed = run(root, *TRAIN, "collect.folder=store", "output=run", limit=400)
        assert how == "done", printed
    files = {"list": ("report.json", "[1]"), "config": ("config.yaml", "- 1"), "training": ("training.json", "[]")}
    files |= {"metrics": ("metrics.csv", "a,b\n1,2\n"), "empty": ("report.json", "{}")}
    files |= {"bomb": ("config.yaml", "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*a, *a]\n" for n in range(9)))}
    for name, (file, text) in files.items():
        (root / "damaged" / name).mkdir(parents=True, exist_ok=True)
        (root / "damaged" / name / "metrics.csv").write_text("step,loss\n1,2\n")
        (root / "damaged" / name / file).write_text(text)
    (root / "damaged/loop").mkdir(exist_ok=True)
    (root / "damaged/loop/report.json").unlink(missing_ok=True)
    (root / "damaged/loop/report.json").symlink_to("report.json")


def commands(root: Path) -> Trials:
    """Command lines that ask for what cannot be: each ends in one sentence."""
    stands = {"CKPT": CHECKPOINT, "STORE": "store/store.json", "DAMAGED": "damaged"}
    for line in (f"{common} {end}".strip() for common, ends in WRONG.items() for end in ends.split()):
        arguments = line
        for name, path in stands.items():
            arguments = arguments.replace(name, path)
        groups = () if "job=" in line or "checkpoint=" in line else (*TRAIN, "collect.folder=store")
        output = () if "checkpoint=last" in line else ("output=wrong",)
        how, printed = run(root, *groups, *arguments.split(), *output)
        yield line, how == "sentence", f"{how}: {last(printed)}"


def headers(root: Path) -> Trials:
    """Stores that describe themselves in nonsense."""
    for key, value in HEADERS:
        copy = root / "header"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(root / "store", copy)
        header = json.loads((copy / "store.json").read_text())
        put(header, key, value)
        (copy / "store.json").write_text(json.dumps(header))
        for job in (("inspect.episode=0",), ()):
            how, printed = run(root, "job=inspect", "inspect.folder=header", "output=wrong", *job)
            harmless = key == "config" and not job  # what only a replay reads
            yield f"{key}={value!r} {job}", how == "sentence" or (harmless and how == "done"), last(printed)


def checkpoints(root: Path) -> Trials:
    """Policies that name something to run or to connect with, through every job that reads one."""
    mark, evil = root / "mark", root / "evil"
    named = f"checkpoint={evil}"
    ways: dict[str, tuple[str, ...]] = {
        "evaluate": (named, *EVALUATE, "output=wrong"),
        "resume": ("resume=evil", "output=evil", "job=train"),
        "pretrained": (f"pretrained={evil}", *TRAIN, "collect.folder=store", "output=wrong"),
        "deploy": (named, "job=deploy", "deploy=ros2", "output=wrong"),
    }
    own = torch.load(root / CHECKPOINT / "checkpoints/last.ckpt", weights_only=True)["config"]
    os.environ["ATTACK_SECRET"] = "hunter2secret"
    with listener() as (port, connected):
        attacks: dict[str, Any] = {}
        for attack, (key, value) in hostile(mark).items():
            attacks[attack] = json.loads(json.dumps(own))
            put(attacks[attack], key, value)
        for attack, config in (attacks | hiding(own, mark, port)).items():
            save_run(evil, config)
            save(evil / "policy", config)
            for way, arguments in ways.items():
                how, printed = run(root, *arguments)
                shutil.rmtree(root / "wrong", ignore_errors=True)
                runs = how == "late" and way == "deploy" and "waiting: " in printed  # until it is stopped
                acted = mark.exists() or connected() or "hunter2secret" in printed
                yield f"{attack}, {way}", not acted and (runs or how in ("sentence", "done")), f"{how}: {last(printed)}"


def disks(root: Path) -> Trials:
    """Every job where no file may grow beyond 20 kB, which is what a full disk looks like."""
    for line in (
        *("job=preview preview.episodes=1", "job=collect collect.episodes=12"),
        *("job=export export=lerobot export.folder=full", "job=inspect inspect.into=full inspect.stores=[store]"),
        *("job=collect collect.episodes=12 collect.images=jpeg", "job=train trainer.max_steps=4"),
        "checkpoint=CKPT evaluate.episodes=1 cluster.workers=1",
        "checkpoint=CKPT policy=onnx policy.folder=full evaluate.episodes=1 cluster.workers=1",
    ):
        arguments = line.replace("CKPT", CHECKPOINT).split(" ")
        small = () if "checkpoint" in line or "preview" in line or "inspect" in line else (*TRAIN[:-1],)
        folder = "collect.folder=full" if "job=collect" in line else "collect.folder=store"
        how, printed = run(root, *small, folder, *arguments, "output=wrong", before=no_room)
        drafts = [
            path
            for path in (*root.rglob(".*.*"), *root.rglob("*.partial"))
            if path.is_file() and "hydra" not in str(path)
        ]
        for path in drafts:
            path.unlink()
        shutil.rmtree(root / "full", ignore_errors=True)
        shutil.rmtree(root / "wrong", ignore_errors=True)
        spared = how == "done" and "cannot be written" in printed  # an evaluation goes on without its recording
        yield (
            line,
            (how == "sentence" or spared) and not drafts,
            f"{how} {[str(path) for path in drafts]}: {last(printed)}",
        )


def no_room() -> None:
    """Let writes beyond 20 kB fail, without the signal that would end the process."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


SECTIONS = {section.__name__: section for section in (
    *(commands, headers, checkpoints, disks, datasets, bags, runs, kills, messages),
)}  # fmt: skip


def main(folder: str, *names: str) -> None:
    """Run sections and print what does not hold, and a line of the table for each; `NAME:N` runs its first N trials."""
    root = Path(folder).resolve()
    prepared(root)
    for name, _, most in (name.partition(":") for name in names or SECTIONS):
        counts: Counter[bool] = Counter()
        for trial, held, how in islice(SECTIONS[name](root), int(most) if most else None):
            counts[held] += 1
            if not held or "-v" in os.environ.get("ABUSE", ""):
                print(f"{'ok ' if held else 'BAD'} {name}: {trial}\n      {how}", flush=True)
        print(f"| {name} | {counts.total()} | {counts[True]} |", flush=True)


if __name__ == "__main__":
    arguments: Sequence[str] = sys.argv[1:]
    main(*arguments)
