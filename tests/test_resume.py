"""Which run is gone on with, and how."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
import torch
import toy
from test_conf import composed

from vla.evaluate import Report, Result
from vla.parts import plain
from vla.report import write_report
from vla.results import note_choice, note_training
from vla.resume import go_on, reported, taken_up


def test_an_evaluation_that_was_interrupted_takes_what_the_training_had_chosen(tmp_path: Path) -> None:
    run = tmp_path / "runs/one"
    (run / "checkpoints").mkdir(parents=True)
    now = composed("checkpoint=last", f"output={tmp_path}/runs/now")
    content = {"config": plain(now), "spec": toy.SPEC.to_dict(), "state_dict": {}, "finished": True}
    torch.save(content, run / "checkpoints/last.ckpt")
    note_training(run, 1, 1, 1.0, "done")
    note_choice(run, "best.ckpt")
    resumed = go_on(now, ["checkpoint=last"])
    assert (resumed.checkpoint, resumed.output) == (str(run / "checkpoints/best.ckpt"), str(run))
    assert not resumed.resume
    another = go_on(now, ["checkpoint=last", "trainer=cpu", "trainer.gradient_clip_val=2"])
    assert another.trainer.max_steps == now.trainer.max_steps
    now.job = "train"
    assert go_on(now, ["checkpoint=last", "job=train"]).checkpoint == str(run / "checkpoints/last.ckpt")


def test_a_training_that_was_killed_between_its_last_save_and_its_end_is_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "one/checkpoints").mkdir(parents=True)
    now = composed("job=train", "checkpoint=last", f"output={tmp_path}/now")
    content = {"config": plain(now), "spec": toy.SPEC.to_dict(), "state_dict": {}, "finished": True}
    torch.save(content, tmp_path / "one/checkpoints/last.ckpt")
    resumed = go_on(now, ["job=train", "checkpoint=last"])
    assert resumed.output == str(tmp_path / "one") and resumed.resume
    note_training(tmp_path / "one", 1, 1, 1.0, "done")
    note_choice(tmp_path / "one", "last.ckpt")
    with pytest.raises(ValueError, match="none of the 1 trainings"):
        go_on(now, ["job=train", "checkpoint=last"])


@pytest.mark.parametrize(("finished", "chosen"), [(False, ""), (True, ""), (True, "best.ckpt")])
def test_a_training_is_taken_up_where_its_folder_has_it(tmp_path: Path, finished: bool, chosen: str) -> None:
    asked = composed(f"output={tmp_path}")
    assert taken_up(asked) is asked  # there is none yet
    (tmp_path / "checkpoints").mkdir()
    content = {"config": plain(asked), "spec": toy.SPEC.to_dict(), "state_dict": {}, "finished": finished}
    torch.save(content, tmp_path / "checkpoints/last.ckpt")
    if chosen:  # which a process that was killed may not have come to
        note_training(tmp_path, 1, 1, 1.0, "done")
        note_choice(tmp_path, chosen)
    asked.evaluate.workers = 1  # not what a training follows from
    found = taken_up(asked)
    assert found is not None
    assert (found.checkpoint, found.resume) == (str(tmp_path / "checkpoints" / (chosen or "last.ckpt")), not chosen)
    asked.job = "train"
    assert (taken_up(asked) is None) == bool(chosen)
    elsewhere = composed(f"output={tmp_path}", "checkpoint=other/last.ckpt", "resume=true", "model.width=17")
    with pytest.raises(ValueError, match="differs in model"):
        taken_up(elsewhere)
    with pytest.raises(ValueError, match=r"differs in model\.width: choose another output=DIR"):
        taken_up(composed(f"output={tmp_path}", "model.width=17"))


def test_a_report_of_weights_that_were_trained_for_longer_since_is_not_this_one(tmp_path: Path) -> None:
    asked = composed(f"output={tmp_path}")
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.touch()
    report = Report((Result(1_000_000, "success"), Result(1_000_001, "dropped")))
    write_report(report, tmp_path / "report.json", str(checkpoint), plain(asked))
    assert reported(asked, checkpoint) == 0.5
    asked.evaluate.episodes += 1
    assert reported(asked, checkpoint) is None
    asked.evaluate.episodes -= 1
    os.utime(checkpoint, (time.time() + 10, time.time() + 10))
    assert reported(asked, checkpoint) is None
