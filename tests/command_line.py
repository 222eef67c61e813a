"""The command line as tests type it, with small numbers: in a process of its own, or in this one."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from unittest.mock import patch

import absl.logging
import warm
from hydra._internal.hydra import Hydra
from omegaconf import DictConfig

SMALL = (
    "validate.episodes=0",
    "task.image_size=[32,32]",
    "task.shadows=false",
    "task.time_limit=5",
    "collect.episodes=12",
    "trainer.max_steps=4",
    "trainer.val_check_interval=2",
    "trainer.accelerator=cpu",
    "data.batch_size=8",
    "data.validation_fraction=0.2",
    "data.validation_windows=8",
    "evaluate.episodes=2",
    "cluster.workers=1",
)
IN_RUN = ("output=run", "hydra.run.dir=run")


def vla(folder: Path, *arguments: str, ok: bool = True) -> subprocess.CompletedProcess[str]:
    """Run `python -m vla.run` in `folder`; its exit status must be what the test expects."""
    done = warm.run(folder, *arguments)
    assert (done.returncode == 0) == ok, done.stdout + done.stderr
    return done


@cache
def _default(folders: object, overrides: tuple[str, ...]) -> DictConfig:
    """The configuration of a job without other overrides, which every command compares its own with."""
    from vla.config.compose import compose

    return compose(*overrides)


def here(folder: Path, *arguments: str, ok: bool = True) -> subprocess.CompletedProcess[str]:
    """What `vla` gives, without a process of its own, which takes seconds: for whatever leaves nothing behind in it.

    The configuration is composed once, not three times: the default is kept, and no argument is `hydra.mode`, for which
    Hydra composes it, too.
    """
    from vla.config.packages import option_folders
    from vla.run import main

    # Hydra closes all handlers of logs, and that of absl then closes its stream unless it is one of Python's own.
    absl.logging.get_absl_handler().python_handler.stream = sys.__stderr__
    out, err, code = StringIO(), StringIO(), 0
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        with (
            patch.object(sys, "argv", ["vla", *arguments]),
            patch.dict(os.environ),
            patch.object(Hydra, "get_mode", return_value=None),
            patch("vla.run.compose", lambda *overrides: _default(tuple(option_folders()), overrides)),
            chdir(folder),
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
    done = subprocess.CompletedProcess(["vla", *arguments], code, out.getvalue(), err.getvalue())
    assert (code == 0) == ok, done.stdout + done.stderr
    return done
