"""What a run left is read as its types, whoever wrote it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from finished_runs import CONFIG, a_run, compared
from hostile import put

from vla.runs.files import Change, Training
from vla.runs.folder import read_run, save_training
from vla.spec import FIRST_SEED


def changed(key: str, value: Any) -> Callable[[str], str]:
    """What makes another text of a JSON object: the value at a key with dots is changed."""

    def change(text: str) -> str:
        content = json.loads(text)
        put(content, key, value)
        return json.dumps(content)

    return change


ODD = {
    "config.task": 5,
    "config.task.tiers": {"easy": 5},
    "config.evaluate": "y",
    "config.evaluate.conditions": {"dark": [1]},
    "config.evaluate.one_by_one": [1],
    "config.evaluate.without": None,
    "config.evaluate.networks": [1],
    "per_episode": [],
    "seeds": [FIRST_SEED] * 4,
}


def test_what_was_written_is_read(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run", "sd")
    save_training(folder, Training(12, 40, 3.0, "done"))
    run = read_run(folder)
    assert run.training == Training(12, 40, 3.0, "done")
    assert (run.policy, run.tasks) == ("BC", [])
    assert run.changes == [Change("model.width", 16, 32)] and run.config["task"] == CONFIG["task"]
    assert run.report is not None and run.reports["seen"].successes == 1
    assert [result.outcome for result in run.reports["seen"].results] == ["success", "dropped"]
    assert [result.outcome for result in run.reports["dark"].results] == ["dropped", "dropped"]


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("report.json", "{", r"report\.json is damaged or of another kind: .*JSON"),
        ("report.json", changed("latency_ms", float("nan")), r"latency_ms: Input should be a finite number"),
        ("report.json", changed("seeds", [1]), r"per_episode has other episodes than seeds"),
        ("report.json", changed("conditions", {"dark": 3}), r"conditions\.dark: "),
        *(("report.json", changed(key, value), rf"another kind: .*{re.escape(key)}") for key, value in ODD.items()),
        ("config.yaml", "- 1", r"config\.yaml is damaged or of another kind: Input should be an object"),
        ("config.yaml", "# " + "x" * (2 << 20), r"config\.yaml has \d+ bytes, more than"),
        ("changes.yaml", "- {key: 1, here: 2}", r"\[0\]\.key: .*; \[0\]\.default: Field required"),
        ("training.json", "{}", r"parameters: Field required"),
        ("training.json", changed("checkpoint", "../../other"), r"checkpoint: Unexpected keyword"),
        ("metrics.csv", "epoch,train/loss\n0,1\n", r"metrics\.csv is damaged in line 1: it has no column step"),
        ("metrics.csv", "step,train/loss\n9,1\nten,2\n", r"metrics\.csv is damaged in line 3: .*'ten'"),
        ("metrics.csv", "step,train/loss\n9,1,2\n", r"line 2: .*longer"),
        (
            "metrics.csv",
            "step,train/loss\n" + "9" * 30 + ",1\n",
            r"line 2: step must be a number from 0 to 2147483647, got 9{30}",
        ),
        ("metrics.csv", "step,train/loss\n9," + "1" * 10**6, r"line 2: field larger"),
    ],
    ids=count(),
)
def test_a_file_of_another_kind_is_refused_by_name_with_a_way_out(
    file: str, content: str | Callable[[str], str], says: str, tmp_path: Path
) -> None:
    folder = a_run(tmp_path / "run")
    save_training(folder, Training(12, 40, 3.0, "done"))
    path = folder / file
    path.write_text(content if isinstance(content, str) else content(path.read_text()))
    with pytest.raises(ValueError, match=says) as refused:
        compared([folder], tmp_path / "new")
    told = str(refused.value)
    assert str(path) in told and told.endswith("; remove the file, or repeat the run")
    assert "\n" not in told and len(told) < 1000 and not (tmp_path / "new").exists()


def test_a_report_without_a_configuration_is_shown(tmp_path: Path) -> None:
    folder, other = a_run(tmp_path / "run"), a_run(tmp_path / "other")
    (folder / "config.yaml").write_text("{}")
    report = folder / "report.json"
    report.write_text(json.dumps({**json.loads(report.read_text()), "config": {}}))
    assert compared([folder, other], tmp_path).read_text().count("100.0") >= 2  # the success of both


def test_what_a_killed_process_left_half_and_points_that_are_no_number_are_not_drawn(tmp_path: Path) -> None:
    curves = "step,train/loss,val/loss\n9,2.5,nan\n19,inf,\n29,-1e400,nan\n39,1.5,\n49"
    run = read_run(a_run(tmp_path / "run", curves=curves))
    assert {name: (at.tolist(), of.tolist()) for name, (at, of) in run.metrics.items()} == {
        "train/loss": ([9, 39], [2.5, 1.5])
    }
    assert "<svg" in compared([run.folder], tmp_path).read_text()
    (run.folder / "metrics.csv").write_text("")
    assert read_run(run.folder).metrics == {}


def test_of_very_many_metrics_the_last_ones_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder = a_run(tmp_path / "run", curves="step,train/loss\n" + "".join(f"{step},0.5\n" for step in range(10, 50)))
    assert len(read_run(folder).metrics["train/loss"][0]) == 40 and not caplog.records
    monkeypatch.setattr("vla.runs.folder.LARGEST_METRICS", 38)  # five rows and a part of one
    steps, values = read_run(folder).metrics["train/loss"]
    assert (steps.tolist(), {*values}) == ([45, 46, 47, 48, 49], {0.5})
    assert "metrics.csv, which has 296 bytes, only the last rows are read" in caplog.text
