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

from vla.config.adopt import require_identity, resume
from vla.config.experiment import to_plain
from vla.models.policy_folder import read_policy
from vla.reports.evaluation import write_report
from vla.rollouts.results import Report, Result
from vla.runs.folder import read_report
from vla.runs.resume import cached_report, newest_run, training_progress

OF_TRAINER = ("trainer.max_steps=9", "trainer.precision=bf16")


def leave(run: Path, config: dict[str, Any], finished: bool, chosen: bool = False) -> None:
    """What a training of `max_steps` leaves; one that was killed at its end may have written a policy only."""
    (run / "checkpoints").mkdir(parents=True)
    steps = config["trainer"]["max_steps"] if finished else 1
    content = {"config": config, "state_dict": {}, "finished": finished, "global_step": steps}
    torch.save(content, run / "checkpoints/last.ckpt")
    if chosen:
        save_policy(run / "policy", config)


def test_the_run_that_was_trained_last_is_the_newest(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="resume=last: nothing was trained in"):
        newest_run(tmp_path)
    for number, name in enumerate(("one", "rounds/round_1", "another")):
        leave(tmp_path / name, to_plain(composed("job=train")), finished=False)
        os.utime(tmp_path / name / "checkpoints/last.ckpt", (number % 2, number % 2))
    assert newest_run(tmp_path) == tmp_path / "rounds"


def test_a_training_without_rounds_is_not_resumed_as_one(tmp_path: Path) -> None:
    leave(tmp_path / "one", to_plain(composed("job=train")), finished=True)
    with pytest.raises(ValueError, match=r"one is a training without rounds: job=improve pretrained="):
        resume(composed(f"output={tmp_path}/now", "job=improve"), tmp_path / "one", ["job=improve"])


def test_a_run_is_resumed_with_its_config_in_its_folder(tmp_path: Path) -> None:
    leave(
        tmp_path / "one",
        to_plain(composed("job=train", "model.width=17", "collect.episodes=3", "trainer.accelerator=cpu", *OF_TRAINER)),
        finished=False,
    )
    now = composed(f"output={tmp_path}/now", "trainer=auto", "trainer.gradient_clip_val=2", "evaluate.episodes=7")
    said = ["trainer=auto", "trainer.gradient_clip_val=2", "evaluate.episodes=7"]
    resumed = resume(now, tmp_path / "one", said)
    assert (resumed.job, resumed.output) == ("train", str(tmp_path / "one"))
    assert (resumed.model.width, resumed.collect.episodes, resumed.evaluate.episodes) == (17, 3, 7)
    assert (resumed.trainer.accelerator, resumed.trainer.gradient_clip_val) == ("auto", 2)
    assert (resumed.trainer.max_steps, resumed.trainer.precision) == (9, "bf16")  # of the run, not of trainer=auto
    longer = resume(now, tmp_path / "one", ["trainer={max_steps: 12}"])  # which merges, as in Hydra
    assert (longer.trainer.max_steps, longer.trainer.precision) == (12, "bf16")
    with pytest.raises(ValueError, match=r"one continues in its own folder: omit output=.*now"):
        resume(now, tmp_path / "one", [f"output={tmp_path}/now"])
    with pytest.raises(ValueError, match="omit checkpoint="):
        resume(composed(f"output={tmp_path}/now", "checkpoint=x"), tmp_path / "one", [])
    with pytest.raises(ValueError, match="other has no training to continue"):
        resume(now, tmp_path / "other", [])
    with pytest.raises(ValueError, match="experiment=few cannot be combined"):
        resume(now, tmp_path / "one", ["experiment=few"])


def test_a_finished_training_of_an_encoder_in_a_relative_folder_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("encoder").mkdir()
    config = to_plain(composed("job=train"))
    config["model"]["text"] = {"_target_": "vla.models.text.huggingface.HuggingFace", "name": "encoder"}
    leave(tmp_path / "one", config, finished=True, chosen=True)
    assert read_policy(tmp_path / "one/policy").config["model"]["text"]["name"] == str(tmp_path / "encoder")
    assert training_progress(tmp_path / "one", config) == (None, tmp_path / "one/policy")
    (tmp_path / "one/checkpoints/last.ckpt").unlink()
    assert training_progress(tmp_path / "one", config) == (None, tmp_path / "one/policy")
    config["model"]["text"]["name"] = "another"
    with pytest.raises(ValueError, match=r"holds a training that differs in model\.text\.name: choose"):
        training_progress(tmp_path / "one", config)


def test_rounds_that_were_moved_are_the_same(tmp_path: Path) -> None:
    def of_rounds(root: Path) -> dict[str, Any]:
        paths = {"pretrained": f"{root}/round_0/policy", "output": f"{root}/round_1"}
        config: dict[str, Any] = {**to_plain(composed("job=train")), **paths}
        config["collect"]["more"] = ["/elsewhere", f"{root}/round_1/episodes"]
        return config

    leave(tmp_path / "moved/round_1", of_rounds(tmp_path / "first"), finished=True, chosen=True)
    now = of_rounds(tmp_path / "moved")
    assert training_progress(tmp_path / "moved/round_1", now) == (None, tmp_path / "moved/round_1/policy")
    now["collect"]["more"][0] = "/other"
    with pytest.raises(ValueError, match=r"holds a training that differs in collect\.more: choose"):
        training_progress(tmp_path / "moved/round_1", now)


def test_one_machine_is_one_whether_a_trainer_says_so_or_not(tmp_path: Path) -> None:
    two = ("job=train", "trainer=ddp", "trainer.devices=2")
    leave(tmp_path / "one", to_plain(composed(*two)), finished=False)
    said = ["trainer=auto", "trainer.devices=2"]
    now = resume(composed(f"output={tmp_path}/now", *said), tmp_path / "one", said)
    assert "num_nodes" not in now.trainer
    require_identity(to_plain(composed(*two)), to_plain(now), tmp_path / "one")


@pytest.mark.parametrize(("finished", "chosen"), [(False, False), (False, True), (True, False), (True, True)])
def test_a_run_continues_in_its_folder(tmp_path: Path, finished: bool, chosen: bool) -> None:
    config = to_plain(composed())
    assert training_progress(tmp_path, config) == (None, None)
    leave(tmp_path, config, finished, chosen)
    last = tmp_path / "checkpoints/last.ckpt"
    whole = finished and chosen
    expected = (None, tmp_path / "policy") if whole else (last, None)
    for name in ("metrics.csv", "report.json", "config.yaml"):
        (tmp_path / name).write_text("[1]")  # damaged, and not needed
    assert training_progress(tmp_path, to_plain(composed("cluster.workers=1"))) == expected
    assert training_progress(tmp_path, to_plain(composed("trainer.max_steps=1"))) == expected
    assert training_progress(tmp_path, to_plain(composed("trainer.max_steps=99999"))) == (last, None)
    for other in ("model.width=17", "+trainer.sync_batchnorm=true", "+trainer.gradient_clip_algorithm=value"):
        key = other.strip("+").partition("=")[0]
        with pytest.raises(ValueError, match=rf"differs in {re.escape(key)}: choose another output=DIR"):
            training_progress(tmp_path, to_plain(composed(other)))


def test_a_training_does_not_begin_in_the_folder_of_rounds(tmp_path: Path) -> None:
    (tmp_path / "round_1/checkpoints").mkdir(parents=True)
    with pytest.raises(ValueError, match="has the rounds of a job=improve: continue them by that job"):
        training_progress(tmp_path, to_plain(composed("job=train")))


def test_a_finished_training_needs_no_checkpoint(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_policy(tmp_path / "policy", to_plain(composed()), global_step=2000)
    done = (None, tmp_path / "policy")
    with caplog.at_level("WARNING"):
        assert training_progress(tmp_path, to_plain(composed())) == done and not caplog.records
        assert training_progress(tmp_path, to_plain(composed("trainer.max_steps=1000"))) == done
    assert "was trained for 2000 steps, more than trainer.max_steps" in caplog.text
    with pytest.raises(ValueError, match=r"differs in model\.width: choose another output=DIR"):
        training_progress(tmp_path, to_plain(composed("model.width=17")))
    with pytest.raises(ValueError, match=r"a longer training would continue from .*last\.ckpt, which is gone: choose"):
        training_progress(tmp_path, to_plain(composed("trainer.max_steps=3000")))


def test_a_report_of_older_weights_or_compared_with_an_older_run_is_not_this_one(tmp_path: Path) -> None:
    policy, other, replayed = (tmp_path / name for name in ("policy", "other/report.json", "store/index.jsonl"))
    for file in (other, replayed):
        file.parent.mkdir()
    asked = to_plain(composed(f"evaluate.against={other.parent}", f"evaluate.nearest={replayed.parent}"))
    report = Report((Result(1_000_000, "success"), Result(1_000_001, "dropped")))
    for changed in (other, replayed):
        for file in (other, replayed):
            file.touch()
        write_report(report, tmp_path / "report.json", str(policy), asked, {"weights": "1"})
        assert cached_report(tmp_path, asked, policy, "1") == read_report(tmp_path)
        assert cached_report(tmp_path, to_plain(composed("evaluate.episodes=9")), policy, "1") is None
        assert cached_report(tmp_path, asked, policy, "2") is None  # copied here with its date
        os.utime(changed, (time.time() + 10, time.time() + 10))
        assert cached_report(tmp_path, asked, policy, "1") is None
