"""What users do, in small: `python tests/behaviours.py FOLDER [--against FILE] [NAME …]`.

Every behaviour is one or more commands in processes of their own, with what must come out of them. `figures` and
`whole` measure what may not change unnoticed: digests of demonstrations, losses, success. All of it is written to
`behaviours.json` in FOLDER; `--against` names such a file of another commit, and every figure that differs is printed.
Digests and losses are equal on one machine only, because processors round differently.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
GOALS = ("lift", "pick_place", "stack", "push", "pick_place_two", "place", "chain")
SMALL = (
    *("task.image_size=[48,48]", "collect.episodes=12", "trainer.max_steps=20", "trainer.val_check_interval=10"),
    *("trainer.accelerator=cpu", "data.batch_size=8", "data.validation_fraction=0.2", "validate.episodes=1"),
    *("evaluate.episodes=2", "cluster.workers=2"),
)
FULL = ("trainer.accelerator=cpu", "validate.episodes=0", "trainer.log_every_n_steps=100")


class Failed(Exception):
    """A behaviour is not as it must be."""


def require(holds: object, what: object) -> None:
    """Raise `Failed` unless something holds."""
    if not holds:
        raise Failed(str(what)[-3000:])


class Bench:
    """Runs commands in a folder, with its store of demonstrations and its first run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start `python -m vla.run`."""
        return subprocess.Popen(
            [sys.executable, "-m", "vla.run", *arguments],
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def run(self, *arguments: str) -> str:
        """Run `python -m vla.run`, which must succeed; returns what it printed."""
        process = self.start(*arguments)
        printed, _ = process.communicate(timeout=3600)
        require(process.returncode == 0, f"{' '.join(arguments)}\n{printed}")
        return printed

    def train(self, name: str, *arguments: str) -> Path:
        """Run the main job in small into the folder `name`; returns it."""
        self.run(*SMALL, f"output={name}", f"hydra.run.dir={name}", *arguments)
        return self.folder / name

    def trained(self) -> Path:
        """Return the folder of a small main job, which runs once."""
        folder = self.folder / "run"
        return folder if (folder / "report.json").exists() else self.train("run", "collect.folder=store")

    def policy(self) -> str:
        """Return the policy of `trained`, as `checkpoint=` takes it."""
        return f"checkpoint={self.trained()}"


def success(folder: Path) -> float:
    """Return the success rate in the report of a run."""
    return json.loads((folder / "report.json").read_text())["success"]


def digest(folder: Path) -> str:
    """Return a hash of all files of a folder but its locks and times."""
    found = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix not in (".lock", ".txt")):
        found.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return found.hexdigest()[:16]


def losses(folder: Path) -> list[float]:
    """Return the training losses of a run."""
    with (folder / "metrics.csv").open() as lines:
        return [float(row["train/loss"]) for row in csv.DictReader(lines) if row.get("train/loss")]


def main_job(bench: Bench) -> None:
    """Demonstrations, a policy, an evaluation, a page and a recording."""
    folder = bench.trained()
    for name in ("report.html", "report.json", "report.png", "rollouts.rrd", "samples.png", "metrics.csv"):
        require((folder / name).stat().st_size > 0, name)
    require(0 <= success(folder) <= 1, "success")
    bench.train("run", "collect.folder=store")  # which is finished, and stays as it is


def preview(bench: Bench) -> None:
    """Scenes and the expert to look at."""
    bench.run("job=preview", "preview.episodes=1", "output=preview", "task.image_size=[48,48]")
    require(list((bench.folder / "preview").glob("*.png")) and list((bench.folder / "preview").glob("*.rrd")), "files")


def several_tasks(bench: Bench) -> None:
    """Goals told apart by language; two tasks of Meta-World."""
    bench.train("multitask", "experiment=multitask", "collect.episodes=15")
    bench.train("metaworld", "experiment=metaworld", "task.tasks=[reach,push]", "task.image_size=[48,48]")


def policies(bench: Bench) -> None:
    """The other policies train and act."""
    for model in ("rt1_tiny", "act", "diffusion", "flow", "decoder"):
        bench.train(model, f"model={model}", "collect.folder=store")


def recording(bench: Bench) -> None:
    """Demonstrations leave as a LeRobot dataset; from one, a policy is trained and judged on held-out episodes."""
    bench.trained()
    bench.run(*SMALL, "job=export", "export=lerobot", "collect.folder=store", "export.folder=lerobot")
    recorded = ("task=recorded", "expert.folder=lerobot", "data.batch_size=8", "trainer.accelerator=cpu")
    short = ("trainer.max_steps=20", "trainer.val_check_interval=10", "task.image_size=[48,48]")
    bench.run(*recorded, *short, "collect.folder=imported", "output=recorded")
    require(json.loads((bench.folder / "recorded/errors.json").read_text())["components"], "errors of actions")


def exports(bench: Bench) -> None:
    """Demonstrations as PNG, NPY and JSON, four files a step."""
    bench.trained()
    bench.run(*SMALL, "job=export", "export=files", "collect.folder=store", "export.folder=files")
    kinds = {path.suffix for path in (bench.folder / "files").rglob("*") if path.is_file()}
    require({".png", ".npy", ".json"} <= kinds, kinds)


def resume(bench: Bench) -> None:
    """A training that was killed ends with the weights of one that was not."""
    bench.trained()
    job = (*SMALL, "job=train", "collect.folder=store", "trainer.max_steps=60", "validate.episodes=0")
    bench.run(*job, "output=whole", "hydra.run.dir=whole")
    process = bench.start(*job, "output=killed", "hydra.run.dir=killed")
    last = bench.folder / "killed/checkpoints/last.ckpt"
    while not last.exists() and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    bench.run("resume=killed", "output=killed", "hydra.run.dir=again")
    require(losses(bench.folder / "killed")[-1:] == losses(bench.folder / "whole")[-1:], "losses")


def server(bench: Bench) -> None:
    """A client that knows the policy only by its address has its success rate."""
    policy = bench.policy()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = bench.start("job=deploy", "deploy=server", policy, f"deploy.port={port}")
    try:
        for _ in range(600):
            with socket.socket() as there:
                if there.connect_ex(("127.0.0.1", port)) == 0:
                    break
            require(process.poll() is None, "the server ended")
            time.sleep(0.1)
        bench.run(*SMALL, "agent=remote", f"agent.url=ws://127.0.0.1:{port}", "output=client", "recorder=none")
    finally:
        process.terminate()
        process.wait(30)
    require(success(bench.folder / "client") == success(bench.trained()), "the client's success rate")


def ros(bench: Bench) -> None:
    """Simulator, policy and operator over ROS 2."""
    bench.run("job=deploy", "deploy=loop", "deploy.episodes=1", bench.policy(), "output=loop")
    require(any((bench.folder / "loop/bag").glob("*.mcap")), "a bag")


def sweep(bench: Bench) -> None:
    """A grid ends in a table."""
    bench.trained()
    bench.run("-m", *SMALL, "collect.folder=store", "learner.lr=1e-3,3e-4", "hydra.sweep.dir=sweep", "recorder=none")
    results, differences = (bench.folder / "sweep/sweep.md").read_text().split("\n\n")
    require(len(results.splitlines()) == 4 and len(differences.splitlines()) >= 3, "rows of sweep.md")


def figures(bench: Bench) -> dict[str, Any]:
    """Return digests of 20 demonstrations of every goal, and losses up to 300 steps."""
    found: dict[str, Any] = {}
    for goal in GOALS:
        bench.run("job=collect", f"task/goal={goal}", "collect.episodes=20", f"collect.folder=goals/{goal}")
        found[f"20 episodes of {goal}"] = digest(bench.folder / "goals" / goal)
    for model in ("bc", "rt1_tiny"):
        output = f"losses_{model}"
        data = ("collect.episodes=100", "collect.folder=hundred", "trainer.max_steps=300")
        bench.run("job=train", f"model={model}", *FULL, *data, f"output={output}")
        found[f"losses of {model}"] = losses(bench.folder / output)
    return found


def whole(bench: Bench) -> str:
    """Return the success of the main job in its full size."""
    printed = bench.run("recorder=none", "collect.folder=five_hundred", "output=main")
    return re.findall(r"success (\d+/\d+)", printed)[-1]


BEHAVIOURS: tuple[Callable[[Bench], Any], ...] = (
    *(main_job, preview, several_tasks, policies, recording, exports, resume, server, ros, sweep, figures, whole),
)
LONG = (figures, whole)


def main() -> int:
    """Run the behaviours that are named, by default all but the long ones; returns the exit status."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help=", ".join(each.__name__ for each in BEHAVIOURS))
    parser.add_argument("--against", type=Path)
    asked = parser.parse_args()
    shutil.rmtree(asked.folder, ignore_errors=True)
    asked.folder.mkdir(parents=True)
    bench, outcome = Bench(asked.folder.resolve()), dict[str, Any]()
    for behaviour in BEHAVIOURS:
        name = behaviour.__name__
        if name not in (asked.names or [each.__name__ for each in BEHAVIOURS if each not in LONG]):
            continue
        began = time.monotonic()
        try:
            outcome[name] = behaviour(bench) or "holds"
        except (Failed, OSError, subprocess.TimeoutExpired) as error:
            outcome[name] = f"FAILED: {error}"
        print(f"{name}: {outcome[name]} ({time.monotonic() - began:.0f} s)", flush=True)
        (asked.folder / "behaviours.json").write_text(json.dumps(outcome, indent=1))
    before = json.loads(asked.against.read_text()) if asked.against else {}
    differ = [name for name, value in before.items() if name in outcome and outcome[name] != value]
    for name in differ:
        print(f"differs: {name}\n  {before[name]}\n  {outcome[name]}")
    return int(bool(differ) or any(str(value).startswith("FAILED") for value in outcome.values()))


if __name__ == "__main__":
    sys.exit(main())
