"""Every command of the README and of the pages beside it: all compose and pass the check, the first ones run."""

from __future__ import annotations

import importlib
import json
import math
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import abuse
import pytest
import torch
from command_line import SMALL, here
from composing import CONF, check, composed
from documented import PAGES, ROOT, commands
from omegaconf import OmegaConf
from saved_policies import change_json

from vla import jobs
from vla.deploy import ros
from vla.io.errors import UserError
from vla.parallel.limits import cores

pytestmark = pytest.mark.usefixtures("recording")

README = PAGES[0].read_text(encoding="utf-8")
COMMANDS = [command for command in commands("vla.run") if command != "--help"]  # which is for `test_run`
TOOLS = [(tool, command) for tool in ("say", "record") for command in commands(f"vla.deploy.{tool}")]
HALF = "outputs/runs/half"
METAWORLD, LIBERO = "metaworld", "libero"
STANDS = {
    "ENCODER": "encoder",
    "HOST": "127.0.0.1",
    "plan.runs=[RUN,RUN]": "plan.runs=[run,outputs/runs/half]",
    "RUN,RUN": "run",
    **{f"{key}=RUN": f"{key}={HALF}" for key in ("resume", "checkpoint", "pretrained")},
}
FROM_A_RUN = [command for command in COMMANDS if re.search("checkpoint=|pretrained=|resume=", command)]


def test_all_the_commands_are_found() -> None:
    assert len(COMMANDS) > 50 and len(TOOLS) >= 10 and commands("tests/abuse.py") == ["FOLDER"]


@pytest.fixture(scope="module")
def folder(home: Path) -> Path:
    """A folder with a RUN, one that was interrupted as it trained for longer, and policies of Meta-World and LIBERO."""
    trained = torch.load(home / "run/checkpoints/last.ckpt", weights_only=True)
    shutil.copytree(home / "run", home / HALF)
    torch.save(trained | {"finished": False}, home / HALF / "checkpoints/last.ckpt")
    for name, option in ((METAWORLD, "experiment=metaworld"), (LIBERO, "task=libero")):
        other: Any = OmegaConf.to_container(composed(option), resolve=True)
        shutil.copytree(home / "run/policy", home / name)
        change_json(home / name / "config.json", lambda config, task=other["task"]: {**config, "task": task})
    return home


def arguments_of(command: str) -> list[str]:
    """The arguments, with what stands for the names in capital letters."""
    if "task.drawn=" in command:  # which a task of Meta-World has
        command = command.replace("checkpoint=RUN", f"checkpoint={METAWORLD}")
    if "libero_pro" in command or "task.suite=" in command:
        command = command.replace("checkpoint=RUN", f"checkpoint={LIBERO}")
    for name, path in STANDS.items():
        command = command.replace(name, path)
    return shlex.split(command)


def cell(command: str, number: int) -> list[str]:
    """The arguments of the first (0) or last (-1) cell of a sweep."""
    swept = [argument for argument in arguments_of(command) if argument != "-m"]
    if "-m" in command.split():
        for name in [argument.partition("=")[2] for argument in swept if argument.startswith("experiment=")]:
            own = OmegaConf.load(CONF / f"experiment/{name}.yaml")
            params = OmegaConf.select(own, "hydra.sweeper.params", default={})  # none if only the command is a grid
            swept += [f"{key}={values}" for key, values in params.items()]
        pairs = [argument.partition("=")[::2] for argument in swept]
        swept = [f"{key}={values.split(',')[number].strip()}" for key, values in pairs]
    return swept


@pytest.mark.parametrize("command", sorted({*COMMANDS} - {*FROM_A_RUN}))
def test_the_command_composes_and_passes_the_check(command: str) -> None:
    for number in (0, -1) if command.startswith("-m") else (0,):
        check(composed(*cell(command, number)))


@pytest.mark.parametrize("command", FROM_A_RUN)
def test_the_command_goes_on_from_a_run(folder: Path, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets as far as its job."""
    asked: list[Any] = []
    monkeypatch.setattr(jobs, "run", asked.append)
    here(folder, *arguments_of(command))
    assert len(asked) == 1


@pytest.mark.parametrize(("tool", "command"), TOOLS)
def test_a_tool_for_the_robot_takes_the_arguments(tool: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They run in `test_deploy`; here they get as far as the network."""
    module = importlib.import_module(f"vla.deploy.{tool}")

    def unplugged(*_: Any, **__: Any) -> None:
        raise UserError("no network")

    monkeypatch.setattr(ros, "ros", unplugged)
    monkeypatch.setattr(sys, "argv", [tool, *shlex.split(command)])
    with pytest.raises(SystemExit) as ended:
        module.main()
    assert ended.value.code == "error: no network"


def require_floors(measures: dict[str, dict[str, Any]]) -> None:
    """Every stage was measured, against a floor of its own; how fast it was is for no test to judge."""
    stages = ("physics", "rendering", "expert, controller, judge", "images into arrays", "replay", "storing")
    assert set(measures) == {
        *("collect", *(f"collect: {stage}" for stage in stages), f"collect: {cores()} processes"),
        *(f"collect: rendering, {name}" for name in ("fast", "smooth", "detailed", "whole", "mujoco")),
        *("loader", "loader: 1 frame", "loader: 6 frames"),
        *(f"loader: 3 x 224 px, {codec}{of}" for codec in ("lossless", "jpeg") for of in ("", ", 2500 x 100 steps")),
        *("train: fp32", "policy"),
    }
    for name, measure in measures.items():
        assert set(measure) == {"value", "unit", "n", "floor", "ratio", "others"} and measure["n"] > 0, name
        assert all(math.isfinite(measure[key]) for key in ("value", "floor", "ratio")) and measure["floor"] > 0, name
    assert measures["train: fp32"]["n"] == 2 * 8
    for codec in ("lossless", "jpeg"):  # 250 000 steps with three images of 224 x 224 pixels take 113 GB raw
        speed, size = (measures[f"loader: 3 x 224 px, {codec}{of}"] for of in ("", ", 2500 x 100 steps"))
        assert (speed["unit"], speed["n"], size["unit"]) == ("windows/s", 2 * 8, "GB")
        assert 0 < size["value"] < 40 and size["floor"] == pytest.approx(112.9, abs=0.1)


def test_the_benchmark_measures_every_stage_against_its_floor(folder: Path) -> None:
    few = ("benchmark.episodes=1", "benchmark.batches=2", "benchmark.steps=2", "benchmark.rounds=1")
    run(folder, "job=benchmark", *SMALL, *few, "output=speed")
    written = json.loads((folder / "speed/benchmark.json").read_text())
    require_floors(written["measures"])
    assert written["machine"]["processor"] and written["machine"]["cores"] == cores()


def test_an_ablation_ends_in_a_table(folder: Path) -> None:
    few = (*SMALL, "collect.episodes=5", "variant=no_history", "seed=0", "evaluate.episodes=1")
    run(folder, "-m experiment=ablation", *few, "hydra.sweep.dir=ablation")
    lines = (folder / "ablation/sweep.md").read_text().splitlines()
    # What cells differ in stands before it: see test_packages.
    assert lines[0].startswith("| seen [%] | instructions [%] | distractors [%] | backgrounds [%] |")
    assert len(lines) == 3


def test_cells_run_as_jobs_of_a_queue(folder: Path) -> None:
    few = ("collect.episodes=1", "cluster.workers=1", "task.image_size=[32,32]")
    command = "-m hydra/launcher=local_queue job=collect task/goal=lift,push"
    run(folder, command, *few, "hydra.sweep.dir=queue")
    assert sorted(path.name for path in (folder / "queue").iterdir() if path.name.isdigit()) == ["0", "1"]


def run(folder: Path, command: str, *arguments: str) -> str:
    """What a documented command prints, with small numbers."""
    assert command in COMMANDS
    return here(folder, *arguments_of(command), *arguments).stdout


def test_the_attacks_in_bulk_are_ready(main_job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A trial of those that docs/results/safety.md counts."""
    (tmp_path / "run").symlink_to(main_job / "run")
    (store,) = (main_job / "outputs/episodes").glob("*/store.json")
    (tmp_path / "store").symlink_to(store.parent)
    abuse.main(str(tmp_path), "headers:1")
    assert capsys.readouterr().out == "| headers | 1 | 1 |\n"


def test_the_program_of_the_readme_plays_an_episode(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(code.replace('"RUN"', repr(str(folder / HALF))), {})
    assert len(capsys.readouterr().out.split()) > 3


def test_ci_runs_make_test_and_the_readme_names_both_commands() -> None:
    assert "make run" in README and "make test" in README
    assert "make test" in (ROOT / ".ci/run").read_text()
    assert re.search(r"^run:.*\n\t\.venv/bin/python -m vla\.run$", (ROOT / "Makefile").read_text(), re.MULTILINE)
