"""Every command of the README and of the pages beside it runs, on small numbers."""

from __future__ import annotations

import json
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

DOCS = Path(__file__).parents[1] / "docs"
README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
TEXTS = "\n".join([README, *(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md")))])
COMMANDS = sorted(set(re.findall(r"^python -m vla\.run ?(.*?)(?: +#.*)?$", TEXTS, re.MULTILINE)))
os.environ["ROS_DOMAIN_ID"] = str(18 + 20 * (int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 5))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small RUN and its checkpoint, FILE, an interrupted run, a LeRobot DATASET and an ENCODER."""
    folder = tmp_path_factory.mktemp("readme")
    write_encoder(folder / "encoder")
    vla(folder, *SMALL, "job=train", "output=run")
    half = torch.load(folder / "run/checkpoints/last.ckpt", weights_only=True) | {"finished": False}
    (folder / "outputs/runs/half/checkpoints").mkdir(parents=True)
    torch.save(half, folder / "outputs/runs/half/checkpoints/last.ckpt")
    vla(folder, *SMALL, "job=export", "export=lerobot", "export.folder=dataset")
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
    """Every stage was measured, against a floor of its own."""
    assert {name.partition(":")[0] for name in measures} == {"collect", "loader", "train", "policy"}
    shares = [measures[f"collect: {stage}"]["ratio"] for stage in ("physics", "rendering", "replay", "storing")]
    assert 0 < sum(shares) < 1
    for measure in measures.values():
        assert set(measure) == {"value", "unit", "n", "floor", "ratio"} and measure["floor"] > 0
    for precision in ("fp32", "bf16"):
        assert measures[f"train: {precision}"]["n"] == 2 * 8
        assert 0 < measures[f"train: {precision}: data-wait"]["ratio"] < 1
        assert 0 < measures[f"train: {precision}: MFU"]["ratio"] < 1
        assert measures[f"train: {precision}: memory"]["ratio"] > 1
        assert measures[f"train: {precision}: loss"]["ratio"] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_runs(home: Path, command: str, request: pytest.FixtureRequest) -> None:
    number = COMMANDS.index(command)
    if "cluster=dask" in command:
        command = command.replace("tcp://HOST:8786", request.getfixturevalue("address"))
    command = command.replace("DATASET", "dataset").replace("ENCODER", "encoder").replace("DIR", f"new{number}")
    command = command.replace("RUN,RUN", "run")
    arguments = shlex.split(command.replace("FILE", "run/checkpoints/last.ckpt"))
    if "--help" in arguments:
        assert "pick_place" in vla(home, *arguments).stdout
        return
    if "job=deploy" in arguments and "deploy=loop" not in arguments:
        serves(home, *arguments)
        return
    small = ["evaluate.episodes=1", "evaluate.workers=1", "preview.episodes=1", "collect.workers=1"]
    small += ["benchmark.episodes=1", "benchmark.batches=2", "benchmark.steps=2"]
    small += ["benchmark.rounds=1", "benchmark.compile=[false]"]
    if not any(argument.startswith("checkpoint=") for argument in arguments):
        small = [*SMALL, *small]
    elif "deploy=loop" in arguments:
        small = ["deploy.episodes=1", "task.time_limit=1", "benchmark.episodes=1"]
    elif {"job=train", "checkpoint=last", "resume=true"} & set(arguments):
        small = ["trainer.max_steps=6"]
    if "cluster=dask" in arguments:
        small += ["collect.folder=remote", "collect.episodes=4"]
    if "experiment=ablation" in arguments:
        small += ["variant=no_transformer,no_history", "seed=0", "hydra.sweep.dir=ablation"]
    if "model=rt1" in arguments:  # at full size a second per frame
        small += [
            "model.history=1",
            "model.image_size=64",
            "data.batch_size=1",
            "data.validation_windows=1",
            "trainer.max_steps=1",
            "trainer.limit_val_batches=0",
        ]
    if arguments == ["job=benchmark"]:
        small += ["output=speed"]
    done = vla(home, *arguments, *small)
    if arguments == ["job=benchmark"]:
        require_floors(json.loads((home / "speed/benchmark.json").read_text()))
    if "seed=0,1" in arguments and "learner.lr=1e-3,3e-4" in arguments:
        assert done.stdout.count("24 episodes, 0 of them new") == 4
        assert done.stdout.count("\ntrained 4 steps") == 4
    if "experiment=ablation" in arguments:
        lines = (home / "ablation/sweep.md").read_text().splitlines()
        assert "| variant | seen [%] | instructions [%] | distractors [%] | backgrounds [%] |" in lines[0]
        assert [line.split()[1] for line in lines[2:]] == ["no_transformer", "no_history"]


def test_the_two_commands_are_what_ci_runs() -> None:
    root = Path(__file__).parents[1]
    assert "make run" in README and "make test" in README
    assert "make test" in (root / ".ci/run").read_text()
    assert re.search(r"^run:.*\n\t\.venv/bin/python -m vla\.run$", (root / "Makefile").read_text(), re.MULTILINE)
