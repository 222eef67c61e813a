"""What the user can mend, at the command line: one sentence for each way to it, before any work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_run import SMALL, vla

from vla.tasks.backend import TRIED

BAD_INPUT = {
    "misspelt key": (("colect.episodes=3",), "collect"),
    "misspelt option": (("model=rt2",), "rt1"),
    "wrong type": (("trainer.max_steps=many",), "trainer.max_steps"),
    "missing checkpoint": (("checkpoint=nowhere.ckpt",), "nowhere.ckpt"),
    "nothing interrupted": (
        ("checkpoint=last", "output=nowhere/now"),
        "none of the 0 trainings in nowhere was interrupted",
    ),
    "no room on the table": (("job=preview", "task.blocks=4", "task.randomize.placement.x=[0.5,0.5]"), "no room"),
    "no dataset": (("job=collect", "expert=lerobot", "expert.folder=nowhere"), "no LeRobot dataset in nowhere"),
    "nothing to compare": (("job=report",), "report.runs=[RUN,RUN]"),
    "no GPU": (("trainer=gpu", *(item for item in SMALL if "accelerator" not in item)), "gpu"),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input_ends_in_one_clear_sentence(tmp_path: Path, name: str) -> None:
    arguments, says = BAD_INPUT[name]
    done = vla(tmp_path, *arguments, ok=False)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and says in errors[0], done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_a_grid_whose_cells_want_several_processes_is_refused(tmp_path: Path, launcher: str) -> None:
    several = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "seed=0")
    done = vla(tmp_path, "-m", f"hydra/launcher={launcher}", *several, ok=False)
    assert "trainer.devices=1" in done.stderr and "submitit_slurm" in done.stderr and "Traceback" not in done.stderr


def test_without_gl_the_error_says_what_to_install(tmp_path: Path) -> None:
    environment = {**os.environ, "MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nowhere.json"}
    del environment[TRIED]
    done = subprocess.run(
        [sys.executable, "-m", "vla.run", "job=preview", "preview.episodes=1"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1 and "libegl1" in done.stderr and "Traceback" not in done.stderr
