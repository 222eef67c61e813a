"""The table of a sweep."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from PIL import Image

from vla.evaluate import Report, Result
from vla.intervals import pooled_interval
from vla.report import write_report
from vla.sweep import tabulate
from vla.sweep_plot import pareto, validated


def cell(sweep: Path, number: int, overrides: list[str], successes: int, latency: float = 2.0, dark: int = 1) -> None:
    """A cell as a run leaves it: 10 episodes, and 5 in the dark."""
    folder = sweep / str(number)
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra/overrides.yaml").write_text("".join(f"- {one}\n" for one in overrides))
    seen = ["success"] * successes + ["timeout"] * (10 - successes)
    in_the_dark = ["success"] * dark + ["dropped"] * (5 - dark) + ["error"] * 5
    plain, other = (Report(tuple(map(Result, range(10), outcomes))) for outcomes in (seen, in_the_dark))
    size = {"parameters": 2_000_000, "latency_ms": latency}
    write_report(plain, folder / "report.json", None, {}, size, {"dark": other})


def test_seeds_are_put_together_and_the_rest_is_told_apart(tmp_path: Path) -> None:
    for number, (model, seed, successes) in enumerate([("bc", 0, 9), ("bc", 1, 7), ("rt1", 0, 10), ("rt1", 1, 8)]):
        cell(tmp_path, number, ["trainer.max_steps=5", f"model={model}", f"seed={seed}"], successes, 9.0 - 7 * seed)
    bc, rt1 = tabulate(tmp_path)
    assert (bc.choices, rt1.choices) == ({"model": "bc"}, {"model": "rt1"})
    assert (bc.successes, bc.episodes) == ({"seen": 16, "dark": 2}, {"seen": 20, "dark": 10})
    assert bc.rates == [0.9, 0.7]
    lines = (tmp_path / "sweep.md").read_text().splitlines()
    assert lines[0] == "| model | seen [%] | dark [%] | each seed [%] | parameters [M] | action [ms] |"
    low, high = (100 * bound for bound in pooled_interval(bc.played["seen"]))
    assert f"| bc | 80.0 ({low:.1f}-{high:.1f}) |" in lines[2] and lines[2].endswith("| 90.0, 70.0 | 2.00 | 2.0 |")
    rows = list(csv.DictReader((tmp_path / "sweep.csv").open()))
    assert [(row["model"], row["condition"]) for row in rows] == [
        ("bc", "seen"),
        ("bc", "dark"),
        ("rt1", "seen"),
        ("rt1", "dark"),
    ]
    assert float(rows[0]["success"]) == pytest.approx(0.8) and rows[0]["cells"] == "2"
    assert Image.open(tmp_path / "sweep.png").width > 500
    assert not list(tmp_path.glob(".*"))


def test_cells_that_failed_are_left_out_and_a_sweep_without_any_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "0/.hydra").mkdir(parents=True)
    assert tabulate(tmp_path) == []
    assert not list(tmp_path.glob("sweep.*"))
    cell(tmp_path, 1, ["model=bc", "seed=0"], 9)
    cell(tmp_path, 2, ["model=rt1", "seed=0"], 9)
    (tmp_path / "2/error.txt").write_text("holds a training that differs in model")  # the report is of another sweep
    (row,) = tabulate(tmp_path)
    assert row.choices == {} and row.name == "all"


def test_a_condition_that_not_every_cell_played_is_left_open(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["evaluate=paper"], 7)
    cell(tmp_path, 1, ["evaluate=default"], 7)
    report = tmp_path / "1/report.json"
    report.write_text(json.dumps({**json.loads(report.read_text()), "conditions": {}}))
    tabulate(tmp_path)
    assert "| default | 70.0 (39.7-89.2) | - |" in (tmp_path / "sweep.md").read_text()
    assert (tmp_path / "sweep.html").exists()


def test_what_is_slower_and_no_better_is_off_the_front(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["model=a"], 7, latency=1.0)
    cell(tmp_path, 1, ["model=b"], 7, latency=3.0)
    cell(tmp_path, 2, ["model=c"], 10, latency=10.0)
    cell(tmp_path, 3, ["model=d"], 0, latency=20.0)
    rows = tabulate(tmp_path)
    assert [row.name for row in pareto(rows, "seen")] == ["a", "c"]
    assert [row.name for row in pareto(rows, "dark")] == ["a"]


def test_success_is_drawn_over_the_time_of_an_action_only_where_that_differs(tmp_path: Path) -> None:
    for number, latency in enumerate((1.0, 1.9)):
        cell(tmp_path, number, [f"model={number}"], 7, latency)
    tabulate(tmp_path)
    without = Image.open(tmp_path / "sweep.png").height
    (tmp_path / "1/report.json").unlink()
    cell(tmp_path, 2, ["model=2"], 7, latency=2.1)
    tabulate(tmp_path)
    assert Image.open(tmp_path / "sweep.png").height > 2 * without


def test_over_the_number_of_demonstrations_success_is_a_curve_under_each_condition(tmp_path: Path) -> None:
    for number, (level, count) in enumerate([("default", 1000), ("default", 50), ("wide", 50), ("wide", 1000)]):
        cell(tmp_path, number, [f"task/randomize={level}", f"collect.episodes={count}"], 5)
    tabulate(tmp_path)
    wide = Image.open(tmp_path / "sweep.png").width
    cell(tmp_path, 4, ["task/randomize=wide", "collect.episodes=50", "trainer.max_steps=1"], 5)
    (tmp_path / "one").mkdir()
    cell(tmp_path / "one", 0, ["collect.episodes=50"], 5)
    cell(tmp_path / "one", 1, ["collect.episodes=70"], 5)
    tabulate(tmp_path / "one")
    assert wide == Image.open(tmp_path / "one/sweep.png").width  # two conditions, side by side


def test_success_over_training_is_that_of_all_seeds_in_validation(tmp_path: Path) -> None:
    for number, (count, seed) in enumerate([(50, 0), (50, 1), (100, 0), (100, 1)]):
        cell(tmp_path, number, [f"collect.episodes={count}", f"seed={seed}"], 5)
    few, many = tabulate(tmp_path)
    without = Image.open(tmp_path / "sweep.png").height
    assert validated(few) == {}
    for seed, share in enumerate((0.25, 0.75)):
        (tmp_path / f"{seed}/config.yaml").write_text("validate: {episodes: 20}")
        (tmp_path / f"{seed}/metrics.csv").write_text(f"step,val/success\n699,{share - 0.25}\n1399,{share}\n")
    assert validated(few) == {700: (10, 40), 1400: (20, 40)} and validated(many) == {}
    tabulate(tmp_path)
    assert Image.open(tmp_path / "sweep.png").height == 2 * without  # a row of its own
