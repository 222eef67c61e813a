"""Which run is resumed, and how."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from composing import composed
from saved_policies import save_policy

from vla.config.adopt import resume
from vla.config.experiment import plain
from vla.reports.evaluation import write_report
from vla.rollouts.results import Report, Result
from vla.runs.folder import save_config
from vla.runs.resume import FOUND, TrainingProgress, cached_success, interrupted_run, training_progress

OF_TRAINER = ("trainer.max_steps=9", "trainer.precision=bf16")


def leave(run: Path, config: dict[str, Any], finished: bool, chosen: bool = False) -> None:
    """What a training of `max_steps` leaves; one that was killed at its end may have written a policy only."""
    (run / "checkpoints").mkdir(parents=True)
    steps = config["trainer"]["max_steps"] if finished else 1
    content = {"config": config, "state_dict": {}, "finished": finished, "global_step": steps}
    torch.save(content, run / "checkpoints/last.ckpt")
    if chosen:
        save_policy(run / "policy", config)


@pytest.fixture(autouse=True)
def nothing_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOUND, "")


def test_the_newest_run_that_did_not_end_is_found(tmp_path: Path) -> None:
    evaluated, trained = plain(composed()), plain(composed("job=train"))
    leave(tmp_path / "whole", trained, finished=True, chosen=True)
    with pytest.raises(ValueError, match="no run in"):
        interrupted_run(tmp_path)
    leave(tmp_path / "unreported", evaluated, finished=True, chosen=True)
    assert interrupted_run(tmp_path) == tmp_path / "unreported"
    leave(tmp_path / "unfinished", trained, finished=False, chosen=True)
    assert interrupted_run(tmp_path) == tmp_path / "unfinished"


def test_a_run_that_was_extended_after_its_report_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, rounds = tmp_path / "run", tmp_path / "rounds"
    leave(run, plain(composed()), finished=True, chosen=True)
    leave(rounds / "round_0", plain(composed("job=train")), finished=True, chosen=True)
    save_config(rounds, plain(composed("job=improve")), [])
    for folder, last in ((run, run), (rounds, rounds / "round_0")):
        monkeypatch.setenv(FOUND, "")
        write_report(Report((Result(0, "success"),)), folder / "report.json", None, {})
        later = time.time() + 10
        os.utime(last / "checkpoints/last.ckpt", (later, later))
        assert interrupted_run(tmp_path) == folder
        os.utime(folder / "report.json", (later, later))


def test_several_processes_are_told_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    with pytest.raises(ValueError, match="each of several processes would search for itself: name the run, resume=RUN"):
        interrupted_run(tmp_path)


def test_a_training_without_rounds_is_not_resumed_as_one(tmp_path: Path) -> None:
    leave(tmp_path / "one", plain(composed("job=train")), finished=True)
    with pytest.raises(ValueError, match=r"one is a training without rounds: job=improve pretrained="):
        resume(composed(f"output={tmp_path}/now", "job=improve"), tmp_path / "one", ["job=improve"])


def test_a_run_is_resumed_with_its_config_in_its_folder(tmp_path: Path) -> None:
    leave(
        tmp_path / "one",
        plain(composed("job=train", "model.width=17", "collect.episodes=3", *OF_TRAINER)),
        finished=False,
    )
    now = composed(f"output={tmp_path}/now", "trainer=cpu", "trainer.gradient_clip_val=2", "evaluate.episodes=7")
    said = ["trainer=cpu", "trainer.gradient_clip_val=2", "evaluate.episodes=7"]
    resumed = resume(now, tmp_path / "one", said)
    assert (resumed.job, resumed.output) == ("train", str(tmp_path / "one"))
    assert (resumed.model.width, resumed.collect.episodes, resumed.evaluate.episodes) == (17, 3, 7)
    assert (resumed.trainer.accelerator, resumed.trainer.gradient_clip_val) == ("cpu", 2)
    assert (resumed.trainer.max_steps, resumed.trainer.precision) == (9, "bf16")  # of the run, not of trainer=cpu
    with pytest.raises(ValueError, match="omit checkpoint="):
        resume(composed(f"output={tmp_path}/now", "checkpoint=x"), tmp_path / "one", [])
    with pytest.raises(ValueError, match="nothing was trained in that folder"):
        resume(now, tmp_path / "other", [])
    with pytest.raises(ValueError, match="experiment=few cannot be combined"):
        resume(now, tmp_path / "one", ["experiment=few"])


@pytest.mark.parametrize(("finished", "chosen"), [(False, False), (False, True), (True, False), (True, True)])
def test_a_run_continues_in_its_folder(tmp_path: Path, finished: bool, chosen: bool) -> None:
    config = plain(composed())
    assert training_progress(tmp_path, config) == TrainingProgress()
    leave(tmp_path, config, finished, chosen)
    last = tmp_path / "checkpoints/last.ckpt"
    whole = finished and chosen
    expected = TrainingProgress(chosen=tmp_path / "policy") if whole else TrainingProgress(resume_from=last)
    for name in ("metrics.csv", "report.json", "config.yaml"):
        (tmp_path / name).write_text("[1]")  # damaged, and not needed
    assert training_progress(tmp_path, plain(composed("cluster.workers=1"))) == expected
    assert training_progress(tmp_path, plain(composed("trainer.max_steps=1"))) == expected
    assert training_progress(tmp_path, plain(composed("trainer.max_steps=99999"))) == TrainingProgress(resume_from=last)
    for other in ("model.width=17", "+trainer.sync_batchnorm=true", "+trainer.gradient_clip_algorithm=value"):
        key = other.strip("+").partition("=")[0]
        with pytest.raises(ValueError, match=rf"differs in {re.escape(key)}: choose another output=DIR"):
            training_progress(tmp_path, plain(composed(other)))


def test_a_report_of_older_weights_or_compared_with_an_older_run_is_not_this_one(tmp_path: Path) -> None:
    policy, other = tmp_path / "policy", tmp_path / "other/report.json"
    other.parent.mkdir()
    asked = plain(composed(f"evaluate.against={other.parent}"))
    report = Report((Result(1_000_000, "success"), Result(1_000_001, "dropped")))
    for changed in (policy, other):
        policy.touch()
        other.touch()
        write_report(report, tmp_path / "report.json", str(policy), asked)
        assert cached_success(tmp_path, asked, policy) == 0.5
        assert cached_success(tmp_path, plain(composed("evaluate.episodes=9")), policy) is None
        os.utime(changed, (time.time() + 10, time.time() + 10))
        assert cached_success(tmp_path, asked, policy) is None
