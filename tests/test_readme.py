"""Every command of the README and of the pages beside it runs, on small numbers."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from test_cluster import address_in, dask
from test_run import SMALL, vla
from tiny_encoder import write_encoder

from vla.processor import has_bfloat16
from vla.workers import cores

DOCS = Path(__file__).parents[1] / "docs"
README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
TEXTS = "\n".join([README, *(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md")))])
COMMANDS = sorted(set(re.findall(r"^python -m vla\.run ?(.*?)(?: +#.*)?$", TEXTS, re.MULTILINE)))
QUICK = (*SMALL, "collect.episodes=8", "evaluate.episodes=1", "task.time_limit=5", "recorder=none")
os.environ["ROS_DOMAIN_ID"] = str(18 + 20 * (int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 5))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small RUN and its checkpoint, FILE, an interrupted run, a LeRobot DATASET and an ENCODER."""
    folder = tmp_path_factory.mktemp("readme")
    write_encoder(folder / "encoder")
    vla(folder, *QUICK, "job=train", "output=run")
    half = torch.load(folder / "run/checkpoints/last.ckpt", weights_only=True) | {"finished": False}
    (folder / "outputs/runs/half/checkpoints").mkdir(parents=True)
    torch.save(half, folder / "outputs/runs/half/checkpoints/last.ckpt")
    vla(folder, *QUICK, "job=export", "export=lerobot", "export.folder=dataset")
    return folder


def serves(folder: Path, *arguments: str) -> None:
    """Start what runs until it is interrupted, and interrupt it once it says something."""
    command = [sys.executable, "-u", "-m", "vla.run", *arguments]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None and process.stdout.readline()
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0, process.stdout.read()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a cluster listens that the README's commands start, on a free port."""
    file = tmp_path_factory.mktemp("cluster") / "scheduler.json"
    scheduler, worker = re.findall(
        r"^dask (.*)$", README.replace("HOST", "127.0.0.1").replace("HERE", "127.0.0.1"), re.M
    )
    with dask(*shlex.split(scheduler), "--port", "0", "--scheduler-file", str(file)):
        address = address_in(file)
        with dask(*shlex.split(worker.replace("tcp://127.0.0.1:8786", address))):
            yield address


def require_floors(measures: dict[str, dict[str, Any]]) -> None:
    """Every stage was measured, against a floor of its own; how fast it was is for no test to judge."""
    stages = ("physics", "rendering", "expert, controller, judge", "images into arrays", "replay", "storing")
    precisions = ("fp32", "bf16") if has_bfloat16() else ("fp32",)
    watched = ("", ": data-wait", ": MFU", ": memory", ": loss")
    assert set(measures) == {
        *("collect", *(f"collect: {stage}" for stage in stages), f"collect: {cores()} processes"),
        *("loader", "loader: 1 frame", "loader: 6 frames"),
        *(f"train: {precision}{what}" for precision in precisions for what in watched),
        *("train: loader alone", "policy", "policy: every frame anew"),
    }
    for name, measure in measures.items():
        assert set(measure) == {"value", "unit", "n", "floor", "ratio"} and measure["n"] > 0, name
        assert all(math.isfinite(measure[key]) for key in ("value", "floor", "ratio")) and measure["floor"] > 0, name
    for precision in precisions:
        assert measures[f"train: {precision}"]["n"] == 2 * 8
        assert measures[f"train: {precision}: MFU"]["ratio"] <= 1


def small(arguments: list[str]) -> list[str]:
    """The small numbers for a command."""
    said = set(arguments)
    if "deploy=loop" in said:
        return ["deploy.episodes=1", "task.time_limit=1", "benchmark.episodes=1"]
    if said >= {"checkpoint=FILE", "job=train"} or said & {"checkpoint=last", "resume=true"}:
        return ["trainer.max_steps=6"]
    few = ["evaluate.episodes=1", "evaluate.workers=1"]
    if "checkpoint=FILE" in said:
        return few
    few = [*QUICK, *few, "preview.episodes=1", "benchmark.episodes=1", "benchmark.batches=2", "benchmark.steps=2"]
    few += ["benchmark.rounds=1", "benchmark.compile=[false]"]
    if said & {"job=collect", "task.image_size=[128,128]"}:
        few += ["collect.episodes=4"]
    if "cluster=dask" in said:
        few += ["collect.folder=remote"]
    if "hydra/launcher=joblib" in said:  # its processes, which begin without the libraries, are for `test_run`
        few += ["hydra.launcher.n_jobs=1"]
    if "experiment=ablation" in said:
        few += ["variant=no_transformer,no_history", "seed=0", "hydra.sweep.dir=ablation"]
    if "experiment=recipe" in said:
        few += ["variant=chunked"]
    if "experiment=learning_curve" in said:
        few += ["task/randomize=default", "collect.episodes=6,8", "hydra.sweep.dir=curve"]
    if "model=rt1" in said:  # at full size a second per frame
        few += ["model.history=1", "model.image_size=32", "model.image.name=efficientnet_b0", "model.layers=1"]
        few += ["data.batch_size=2", "data.validation_windows=1", "trainer.max_steps=1", "trainer.limit_val_batches=0"]
    if arguments == ["job=benchmark"]:
        few += ["output=speed"]
    return few


def require_results(home: Path, arguments: list[str], printed: str) -> None:
    """What some commands leave, and print, beside doing without an error."""
    if "--help" in arguments:
        assert "pick_place" in printed
    if arguments == ["job=benchmark"]:
        require_floors(json.loads((home / "speed/benchmark.json").read_text()))
    if "learner.lr=1e-3,3e-4" in arguments:
        assert printed.count("8 episodes, 0 of them new") == 4
        assert printed.count("\ntrained 4 steps") == 4
    if "experiment=ablation" in arguments:
        lines = (home / "ablation/sweep.md").read_text().splitlines()
        assert "| variant | seen [%] | instructions [%] | distractors [%] | backgrounds [%] |" in lines[0]
        assert [line.split()[1] for line in lines[2:]] == ["no_transformer", "no_history"]
    if "experiment=learning_curve" in arguments:
        lines = (home / "curve/sweep.md").read_text().splitlines()
        assert "| collect.episodes | seen [%] | wide [%] |" in lines[0] and len(lines) == 4


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_runs(home: Path, command: str, request: pytest.FixtureRequest) -> None:
    arguments = shlex.split(command)
    numbers = [] if arguments == ["--help"] else small(arguments)
    folder = f"new{COMMANDS.index(command)}"
    stands = {"DATASET": "dataset", "ENCODER": "encoder", "FILE": "run/checkpoints/last.ckpt", "RUN,RUN": "run"}
    if "cluster=dask" in command:
        stands["tcp://HOST:8786"] = request.getfixturevalue("address")
    for name, path in {**stands, "DIR": folder}.items():
        command = command.replace(name, path)
    if "job=deploy" in arguments and "deploy=loop" not in arguments:
        serves(home, *shlex.split(command))
    else:
        require_results(home, arguments, vla(home, *shlex.split(command), *numbers).stdout)


def test_the_two_commands_are_what_ci_runs() -> None:
    root = Path(__file__).parents[1]
    assert "make run" in README and "make test" in README
    assert "make test" in (root / ".ci/run").read_text()
    assert re.search(r"^run:.*\n\t\.venv/bin/python -m vla\.run$", (root / "Makefile").read_text(), re.MULTILINE)
