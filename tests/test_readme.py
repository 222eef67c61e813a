"""Every command of the README runs, on small numbers."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from test_run import SMALL, vla

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^python -m vla\.run ?(.*?)(?: +#.*)?$", README, re.MULTILINE)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small trained checkpoint, as FILE."""
    folder = tmp_path_factory.mktemp("readme")
    vla(folder, *SMALL, "job=train", "output=run")
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_runs(home: Path, command: str) -> None:
    arguments = shlex.split(command.replace("FILE", "run/checkpoints/last.ckpt").replace("DIR", "plain"))
    if "--help" in arguments:
        assert "pick_place" in vla(home, *arguments).stdout
        return
    if "deploy=NAME" in arguments:  # there is no deployment yet, which is what the answer says
        assert "deploy=" in vla(home, "job=deploy", "checkpoint=run/checkpoints/last.ckpt", ok=False).stderr
        return
    small = ["evaluate.episodes=1", "evaluate.workers=1", "preview.episodes=1", "collect.workers=1"]
    small += ["benchmark.episodes=1", "benchmark.batches=2", "benchmark.steps=2"]
    if not any(argument.startswith("checkpoint=") for argument in arguments):
        small = [*SMALL, *small]
    elif "job=train" in arguments:
        small = [*SMALL, "trainer.max_steps=6"]
    if "model=rt1" in arguments:  # a second per frame
        small += [
            "data.batch_size=1",
            "data.validation_windows=1",
            "trainer.max_steps=1",
            "trainer.limit_val_batches=0",
        ]
    vla(home, *arguments, *small)


def test_the_two_commands_are_what_ci_runs() -> None:
    root = Path(__file__).parents[1]
    assert "make run" in README and "make test" in README
    assert "make test" in (root / ".ci/run").read_text()
    assert re.search(r"^run:.*\n\t\.venv/bin/python -m vla\.run$", (root / "Makefile").read_text(), re.MULTILINE)
