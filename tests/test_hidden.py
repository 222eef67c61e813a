"""What a checkpoint hides from a check: no code of it runs, nobody is called, and no secret leaves."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from composing import check, composed
from crafted import hiding, listener, save
from omegaconf import DictConfig

from vla import jobs
from vla.config.adopt import adopt, finetune
from vla.config.experiment import Experiment, make_policy, plain
from vla.models.checkpoint import read_header
from vla.runs.resume import training_progress

ATTACKS = list(hiding(plain(composed("expert=waypoint")), Path(), 0))
SECRET = "hunter2secret"


def run_job(cfg: DictConfig) -> None:
    """Check and run a job as the command line does."""
    check(cfg)
    jobs.run(Experiment.of(cfg))


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_that_is_hidden_acts(attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ATTACK_SECRET", SECRET)
    mark = tmp_path / "mark"
    with listener() as (port, connected):
        config = hiding(plain(composed("expert=waypoint", "trainer=cpu")), mark, port)[attack]
        path = save(tmp_path / "theirs/last.ckpt", config)
        small = ("output=mine", "cluster.workers=1", "evaluate.episodes=1", "recorder=none")

        def adopted(*options: str) -> Callable[[], None]:
            return lambda: run_job(adopt(composed(*small, f"checkpoint={path}", *options), []))

        ways: dict[str, Callable[[], Any]] = {
            "policy": lambda: make_policy(plain(composed().policy), path),  # as programs do
            "evaluate": adopted(),
            "export": adopted("job=export", "export=program", "export.folder=new"),
            "deploy": adopted("job=deploy", "deploy=ros2"),
            "pretrained": lambda: run_job(finetune(composed(*small, f"pretrained={path}", "job=train"), [])),
            "improve": lambda: run_job(finetune(composed(*small, f"pretrained={path}", "job=improve"), [])),
        }
        for way, do in ways.items():
            with pytest.raises(ValueError):
                do()
            assert not mark.exists() and not connected(), way
    written = [file for file in (tmp_path / "mine").rglob("*") if file.is_file()]
    assert not any(SECRET in file.read_bytes().decode("latin-1") for file in written)


@pytest.mark.parametrize("attack", [attack for attack in ATTACKS if "secret" in attack])
def test_no_reference_is_read(attack: str, tmp_path: Path) -> None:
    path = save(tmp_path / "last.ckpt", hiding(plain(composed("expert=waypoint")), tmp_path / "mark", 0)[attack])
    with pytest.raises(ValueError, match=r"last\.ckpt cannot be read as a checkpoint"):
        read_header(path)


def test_the_policy_that_a_run_names_is_the_one_that_is_checked(tmp_path: Path) -> None:
    mark, config = tmp_path / "mark", plain(composed("expert=waypoint", f"output={tmp_path}"))
    attack = hiding(config, mark, 0)["python in a mapping that hides it"]
    plainly = {**config, "tokenizer": attack["tokenizer"]._shown}
    for theirs, says in ((attack, "cannot be read as a checkpoint"), (plainly, r"differs in tokenizer\.bins")):
        save(tmp_path / "checkpoints/last.ckpt", config, finished=True)
        save(tmp_path / "checkpoints/best.ckpt", theirs, finished=True)
        ended = {"parameters": 1, "steps": 0, "seconds": 1.0, "ended": "done", "checkpoint": "best.ckpt"}
        (tmp_path / "training.json").write_text(json.dumps(ended))
        with pytest.raises(ValueError, match=says):
            training_progress(tmp_path, config)
        assert not mark.exists()
