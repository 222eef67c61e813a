"""Jobs that are killed at random moments, and started again until they end."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
import warm
from trials import CHECKPOINT, SMALL, TRAIN, Trials, digest, ended, last, run

MEASURED = ("latency", "budget", "seconds", "duration", "_ms", "_s")  # what no two evaluations have in common
PLACES = ("output", "folder", "command")  # of the run
LONGER = (*TRAIN, "trainer.max_steps=60", "trainer.val_check_interval=5", "data.validation_fraction=0.2")


def kills(root: Path) -> Trials:
    """Each job ends up with what it makes uninterrupted."""
    yield from collections(root)
    train = (*LONGER, "collect.folder=store", "output=OUT")
    yield from killed(root, "train", train, 2, 3, weights)
    evaluate = (f"checkpoint={CHECKPOINT}", "evaluate.episodes=6", "cluster.workers=1", "output=OUT")
    yield from killed(root, "evaluate", evaluate, 1, 3, reported)
    for format in ("lerobot", "files"):
        export = (*SMALL, "job=export", f"export={format}", "export.folder=OUT", "collect.folder=store", "output=wrong")
        yield from killed(root, f"export {format}", export, 1, 2, digest)


def killed(
    root: Path, job: str, arguments: tuple[str, ...], products: int, times: int, content: Callable[[Path], Any]
) -> Trials:
    """Make something uninterrupted; then, so many times over, kill the job so many times before it may end."""
    chance = random.Random(0)
    shutil.rmtree(root / "whole", ignore_errors=True)
    began = time.monotonic()
    how, printed = run(root, *(argument.replace("OUT", "whole") for argument in arguments), limit=400)
    takes = time.monotonic() - began
    assert how == "done", printed
    expected = content(root / "whole")
    assert expected
    for product in range(products):
        shutil.rmtree(root / "again", ignore_errors=True)
        again, ends = [argument.replace("OUT", "again") for argument in arguments], []

        def kill(process: int) -> None:
            time.sleep(chance.uniform(0.3, 1.0) * takes)
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)

        for _ in range(times):
            done = warm.run(root, *again, meanwhile=kill)
            ends.append("killed" if done.returncode < 0 else ended(done.returncode, done.stdout + done.stderr)[0])
        how, printed = run(root, *again, limit=400)
        same = how == "done" and content(root / "again") == expected
        names = f"{job} {product}: {', '.join(ends)}"
        yield names, same and {*ends} <= {"killed", "done"}, f"{how}: {last(printed)}"


def weights(output: Path) -> dict[str, bytes]:
    """The bytes of all weights of the newest checkpoint, and of the optimiser's state."""
    content = torch.load(output / "checkpoints/last.ckpt", weights_only=True)
    found = dict(content["state_dict"])
    for optimizer in content["optimizer_states"]:
        found |= {f"{key}.{name}": value for key, of in optimizer["state"].items() for name, value in of.items()}
    tensors = {name: value.numpy().tobytes() for name, value in found.items() if isinstance(value, torch.Tensor)}
    return {**tensors, "steps": str(content["global_step"]).encode()}


def reported(output: Path) -> Any:
    """What a report says, apart from times and folders."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(of) for key, of in value.items() if not key.endswith(MEASURED) and key not in PLACES}
        return [plain(of) for of in value] if isinstance(value, list) else value

    return plain(json.loads((output / "report.json").read_text()))


def collections(root: Path, times: int = 10) -> Trials:
    """Collections killed with their workers at a random moment, some of them by two interrupts."""
    chance = random.Random(0)
    arguments = ("job=collect", *SMALL, "collect.folder=killed", "output=wrong")
    expected = stored(root / "store")
    for trial in range(1, times + 1):
        command, quiet = [sys.executable, "-m", "vla.run", *arguments], subprocess.DEVNULL
        process = subprocess.Popen(command, cwd=root, start_new_session=True, stdout=quiet, stderr=quiet)
        time.sleep(chance.uniform(2, 9))
        twice = trial % 4 == 0
        for _ in range(1 + twice):
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGINT) if twice else os.killpg(process.pid, signal.SIGKILL)
            time.sleep(0.3)
        try:
            process.wait(15)
            over = True
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            over = False
        if trial % 5 == 0 or not over:
            how, _ = run(root, *arguments)
            same = stored(root / "killed") == expected
            shutil.rmtree(root / "killed", ignore_errors=True)
            yield f"collect, {trial} {'Ctrl-C twice' if twice else 'SIGKILL'}", over and how == "done" and same, how


def stored(folder: Path) -> dict[str, str]:
    """The files of a store, apart from how long it took to collect."""
    return digest(folder, ".bin", ".json", ".jsonl")
